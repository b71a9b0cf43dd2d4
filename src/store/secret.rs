//! Random secret of a store, created once.

use std::fs::{File, OpenOptions};
use std::io::{self, Write as _};
use std::path::Path as FilePath;

use bytes::Bytes;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode};

/// Name of the secret in the root of the store, outside the folders that are cleaned up.
const NAME: &str = "secret";
/// Bytes of a secret.
const BYTES: usize = 32;

/// Secret of 256 random bits.
pub(crate) type Secret = [u8; BYTES];

/// Reads the secret in the folder `root`, or creates it. Only the owner may read the file. Blocks.
pub(super) fn in_folder(root: &FilePath) -> io::Result<Secret> {
    let path = root.join(NAME);
    match std::fs::read(&path) {
        Ok(bytes) => return secret(&bytes),
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(error) => return Err(error),
    }
    let fresh = random()?;
    // The name appears with the complete content. Of processes that create it at once, one succeeds.
    let staged = root.join(format!(".{NAME}.{}.tmp", unique()?));
    let mut options = OpenOptions::new();
    options.write(true).create(true).truncate(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = options.open(&staged)?;
    file.write_all(&fresh)?;
    file.sync_all()?;
    let linked = std::fs::hard_link(&staged, &path);
    std::fs::remove_file(&staged)?;
    match linked {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => return secret(&std::fs::read(&path)?),
        linked => linked?,
    }
    #[cfg(unix)]
    File::open(root)?.sync_all()?;
    Ok(fresh)
}

/// Fails if the folder `root` has no secret, or another one than `expected`. Blocks.
pub(super) fn is_in_folder(root: &FilePath, expected: Option<&Secret>) -> io::Result<()> {
    let found = match std::fs::read(root.join(NAME)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => None,
        found => Some(found?),
    };
    if found.is_some_and(|found| expected.is_none_or(|expected| found == expected)) {
        return Ok(());
    }
    Err(io::Error::other("the folder of the store is missing, or another folder is in its place"))
}

/// Fails if a bucket has no secret.
pub(super) async fn is_in_bucket(objects: &dyn ObjectStore) -> object_store::Result<()> {
    objects.head(&Path::from(NAME)).await.map(|_| ())
}

/// Returns 16 random hexadecimal digits, for names that no other process chooses.
pub(super) fn unique() -> io::Result<String> {
    let [a, b, c, d, e, f, g, h, ..] = random()?;
    Ok(format!("{:016x}", u64::from_be_bytes([a, b, c, d, e, f, g, h])))
}

/// Reads the secret in a bucket, or creates it. Processes that create it at once get the same one.
pub(super) async fn in_bucket(objects: &dyn ObjectStore) -> object_store::Result<Secret> {
    let path = Path::from(NAME);
    let generic = |error: io::Error| object_store::Error::Generic { store: "S3", source: error.into() };
    match objects.get(&path).await {
        Ok(read) => return secret(&read.bytes().await?).map_err(generic),
        Err(object_store::Error::NotFound { .. }) => {}
        Err(error) => return Err(error),
    }
    let fresh = random().map_err(generic)?;
    match objects.put_opts(&path, Bytes::copy_from_slice(&fresh).into(), PutMode::Create.into()).await {
        Ok(_) => Ok(fresh),
        Err(object_store::Error::AlreadyExists { .. }) => {
            secret(&objects.get(&path).await?.bytes().await?).map_err(generic)
        }
        Err(error) => Err(error),
    }
}

fn random() -> io::Result<Secret> {
    let mut bytes = [0; BYTES];
    getrandom::fill(&mut bytes)?;
    Ok(bytes)
}

fn secret(bytes: &[u8]) -> io::Result<Secret> {
    bytes
        .try_into()
        .map_err(|_other_length| io::Error::other(format!("a secret has {BYTES} bytes, this one has {}", bytes.len())))
}

#[cfg(test)]
mod tests {
    use object_store::memory::InMemory;

    use super::*;

    #[test]
    fn a_folder_keeps_its_secret_readable_only_by_its_owner() {
        let [dir, other] = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let first = in_folder(dir.path()).unwrap();
        assert_eq!(in_folder(dir.path()).unwrap(), first);
        assert_ne!(in_folder(other.path()).unwrap(), first);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "no staged file remains");
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt as _;
            let mode = std::fs::metadata(dir.path().join(NAME)).unwrap().permissions().mode();
            assert_eq!(mode & 0o777, 0o600);
        }
        // A damaged secret is not replaced: with a new one, repeated idempotency keys would start new jobs.
        std::fs::write(dir.path().join(NAME), b"short").unwrap();
        assert!(in_folder(dir.path()).unwrap_err().to_string().contains("has 5"));
    }

    #[tokio::test]
    async fn a_bucket_keeps_its_secret() {
        let (bucket, other) = (InMemory::new(), InMemory::new());
        let first = in_bucket(&bucket).await.unwrap();
        assert_eq!(in_bucket(&bucket).await.unwrap(), first);
        assert_ne!(in_bucket(&other).await.unwrap(), first);
        let (a, b) = (InMemory::new(), Path::from(NAME));
        a.put(&b, Bytes::from_static(b"short").into()).await.unwrap();
        assert!(in_bucket(&a).await.unwrap_err().to_string().contains("has 5"));
    }
}
