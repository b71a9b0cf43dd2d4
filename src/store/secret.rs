//! Random secret of a store, created once.

use std::io::{self, Write as _};
use std::path::Path as FilePath;

use bytes::Bytes;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode};
use tempfile::Builder;

use super::lock::sync_folder;

/// Name of the secret in the root of the store, outside the folders that are cleaned up.
const NAME: &str = "secret";
/// Bytes of a secret.
const BYTES: usize = 32;

/// Secret of 256 random bits.
pub(crate) type Secret = [u8; BYTES];

/// Reads the secret in the folder `root`, or creates it. Only the owner may read the file. Blocks.
pub(super) fn in_folder(root: &FilePath) -> io::Result<Secret> {
    match std::fs::read(root.join(NAME)) {
        Ok(bytes) => secret(&bytes),
        Err(error) if error.kind() == io::ErrorKind::NotFound => create_in_folder(root),
        Err(error) => Err(error),
    }
}

/// Creates the secret in the folder `root`, or reads that of a process that was faster.
fn create_in_folder(root: &FilePath) -> io::Result<Secret> {
    let (path, fresh) = (root.join(NAME), random()?);
    // The name appears with the complete content. Of processes that create it at once, one succeeds.
    let prefix = format!(".{NAME}.");
    let mut staged = Builder::new().prefix(&prefix).suffix(".tmp").tempfile_in(root)?;
    staged.write_all(&fresh)?;
    staged.as_file().sync_all()?;
    match staged.persist_noclobber(&path).map_err(|refused| refused.error) {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => return secret(&std::fs::read(&path)?),
        persisted => drop(persisted?),
    }
    sync_folder(root)?;
    Ok(fresh)
}

/// Fails if the folder `root` has no secret, or another one than `expected`. Blocks.
pub(super) fn is_in_folder(root: &FilePath, expected: &Secret) -> io::Result<()> {
    let found = match std::fs::read(root.join(NAME)) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => None,
        found => Some(found?),
    };
    if found.is_some_and(|found| found == expected) {
        return Ok(());
    }
    Err(io::Error::other("the folder of the store is missing, or another folder is in its place"))
}

/// Returns 16 random hexadecimal digits, for names that no other process chooses.
pub(super) fn unique() -> io::Result<String> {
    let [a, b, c, d, e, f, g, h, ..] = random()?;
    Ok(format!("{:016x}", u64::from_be_bytes([a, b, c, d, e, f, g, h])))
}

/// Reads the secret in a bucket, or creates it.
pub(super) async fn in_bucket(objects: &dyn ObjectStore) -> object_store::Result<Secret> {
    match read(objects).await {
        Err(object_store::Error::NotFound { .. }) => create_in_bucket(objects).await,
        read => read,
    }
}

/// Creates the secret in a bucket, or reads that of a process that was faster.
async fn create_in_bucket(objects: &dyn ObjectStore) -> object_store::Result<Secret> {
    let (path, fresh) = (Path::from(NAME), random().map_err(generic)?);
    match objects.put_opts(&path, Bytes::copy_from_slice(&fresh).into(), PutMode::Create.into()).await {
        Ok(_) => Ok(fresh),
        Err(object_store::Error::AlreadyExists { .. }) => read(objects).await,
        Err(error) => Err(error),
    }
}

/// Reads the secret in a folder or a bucket.
pub(super) async fn read(objects: &dyn ObjectStore) -> object_store::Result<Secret> {
    secret(&objects.get(&Path::from(NAME)).await?.bytes().await?).map_err(generic)
}

fn generic(error: io::Error) -> object_store::Error {
    object_store::Error::Generic { store: "store", source: error.into() }
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
    use crate::store::faulty::{Creation, objects_created};

    #[test]
    fn processes_that_create_the_secret_of_a_folder_at_once_share_it() {
        let dir = tempfile::tempdir().unwrap();
        // No process has found a secret.
        let create = || create_in_folder(dir.path()).unwrap();
        let secrets = std::thread::scope(|scope| {
            let threads: Vec<_> = std::iter::repeat_with(|| scope.spawn(create)).take(8).collect();
            threads.into_iter().map(|thread| thread.join().unwrap()).collect::<Vec<_>>()
        });
        assert!(secrets.iter().all(|secret| *secret == secrets[0]), "{secrets:?}");
        assert_eq!(in_folder(dir.path()).unwrap(), secrets[0]);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "no staged file remains");
    }

    #[tokio::test]
    async fn processes_that_create_the_secret_of_a_bucket_at_once_share_it() {
        // No process has found a secret.
        let create = async |objects: &dyn ObjectStore| {
            let (one, other) = tokio::join!(create_in_bucket(objects), create_in_bucket(objects));
            [one.unwrap(), other.unwrap(), in_bucket(objects).await.unwrap()]
        };
        let [one, other, read] = create(&InMemory::new()).await;
        assert_eq!([other, read], [one, one]);
        // The control: a store without conditional writes, which is refused at the start.
        let dir = tempfile::tempdir().unwrap();
        let [one, other, _] = create(objects_created(Creation::Replacing, dir.path()).as_ref()).await;
        assert_ne!(one, other);
    }

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
