//! Checks of a store with small objects, at the start and while the service runs.

use std::io;

use bytes::Bytes;
use object_store::path::Path;
use object_store::{ObjectStoreExt as _, PutMode};

use super::backend::{Backend, CHECK};
use super::error::StoreError;
use super::secret;

impl Backend {
    /// Runs the checks of the start: [`check`](Self::check), conditional creation, and the secret, which must be absent
    /// or undamaged.
    pub(super) async fn check_start(&self) -> Result<(), StoreError> {
        self.check().await?;
        self.check_creation().await?;
        match self.timed(secret::read(self.objects().as_ref())).await {
            Ok(_) | Err(object_store::Error::NotFound { .. }) => Ok(()),
            Err(error) => Err(self.fail("secret", "secret", &error)),
        }
    }

    /// Writes, reads and removes a small object.
    pub(super) async fn check(&self) -> Result<(), StoreError> {
        self.check_folder().await?;
        // Nodes that share a store may have the same process id.
        let file = secret::unique().map_err(|e| self.fail("check", CHECK, &e))?;
        let path = Path::from_iter([CHECK, &file]);
        let fail = |e: object_store::Error| self.fail("check", path.as_ref(), &e);
        let written = Bytes::from(file.into_bytes());
        let answered = async {
            self.objects().put(&path, written.clone().into()).await?;
            let read = self.objects().get(&path).await?.bytes().await?;
            self.objects().delete(&path).await.map(|()| read)
        };
        let read = self.timed(answered).await.map_err(fail)?;
        if read == written {
            return Ok(());
        }
        Err(self.fail("check", path.as_ref(), &io::Error::other("the bytes read differ from the bytes written")))
    }

    /// Checks that the store creates an object and refuses to replace it. Otherwise nodes could record two jobs for one
    /// idempotency key, replace the end of a job, or have different secrets.
    async fn check_creation(&self) -> Result<(), StoreError> {
        let file = secret::unique().map_err(|e| self.fail("check", CHECK, &e))?;
        let path = Path::from_iter([CHECK, &file]);
        let create = |content: &'static [u8]| {
            self.objects().put_opts(&path, Bytes::from_static(content).into(), PutMode::Create.into())
        };
        let answered = async {
            // The client repeats a request that was not answered, so the first one may find its own object.
            match create(b"first").await {
                Ok(_) | Err(object_store::Error::AlreadyExists { .. }) => {}
                Err(error) => return Err(error),
            }
            let second = create(b"second").await;
            let kept = self.objects().get(&path).await?.bytes().await?;
            self.objects().delete(&path).await?;
            match second {
                Err(object_store::Error::AlreadyExists { .. }) => Ok(kept == "first"),
                Err(error) => Err(error),
                Ok(_) => Ok(false),
            }
        };
        let why = match self.timed(answered).await {
            Ok(true) => return Ok(()),
            Ok(false) => "it replaced an object".to_owned(),
            Err(error) => error.to_string(),
        };
        let why = format!("{why}; the store must support conditional writes (If-None-Match: *)");
        Err(self.fail("check", path.as_ref(), &io::Error::other(why)))
    }
}
