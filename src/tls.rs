//! TLS provider of the process.

/// Makes ring the cryptography provider of rustls. Must run before the first HTTP client is built; later calls have no
/// effect.
pub(crate) fn install_provider() {
    // An error means that a provider is installed already.
    drop(rustls::crypto::ring::default_provider().install_default());
}
