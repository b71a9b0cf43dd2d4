//! Tracer and export of spans: the OpenTelemetry SDK, set up from the configuration.

use std::thread;
use std::time::Duration;

use ::metrics::counter;
use opentelemetry::InstrumentationScope;
use opentelemetry::trace::TracerProvider as _;
use opentelemetry_otlp::{Protocol, WithExportConfig as _, WithHttpConfig as _};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::error::OTelSdkResult;
use opentelemetry_sdk::trace::{
    BatchConfigBuilder, BatchSpanProcessor, Sampler, SdkTracer, SdkTracerProvider, SpanData, SpanExporter,
    TracerProviderBuilder,
};
use reqwest::blocking::Client;
use reqwest::redirect::Policy;

use super::{TRACE_SPANS, TelemetryError};
use crate::config::{SecretHeaders, TelemetryConfig};

/// Maximum number of spans in one request to the collector, the default of OpenTelemetry's exporters.
const BATCH_SIZE: usize = 512;
/// Maximum time that spans wait for a batch to fill.
const BATCH_DELAY: Duration = Duration::from_secs(1);

/// Creates spans. The default tracer records nothing and continues traces only.
#[derive(Debug, Clone)]
pub(crate) struct Tracer(pub(super) SdkTracer);

impl Default for Tracer {
    fn default() -> Self {
        Traces::off().tracer()
    }
}

/// Tracer provider of a service, with the batch processor if a collector is configured.
#[derive(Debug)]
pub(crate) struct Traces {
    provider: SdkTracerProvider,
    flush_timeout: Duration,
}

impl Traces {
    /// Sets up the tracer provider and starts the export thread if the configuration names a collector.
    pub(crate) fn start(config: &TelemetryConfig) -> Result<Self, TelemetryError> {
        let Some(endpoint) = &config.endpoint else { return Ok(Self::off()) };
        let batch = BatchConfigBuilder::default()
            .with_max_queue_size(config.queue)
            .with_max_export_batch_size(BATCH_SIZE)
            .with_scheduled_delay(BATCH_DELAY)
            .build();
        let processor = BatchSpanProcessor::builder(exporter(config, endpoint)?).with_batch_config(batch).build();
        let resource = Resource::builder_empty()
            .with_service_name("molmesh")
            .with_attribute(opentelemetry::KeyValue::new("service.version", env!("CARGO_PKG_VERSION")))
            .build();
        let provider = provider(config.sample_ratio).with_resource(resource).with_span_processor(processor).build();
        Ok(Self { provider, flush_timeout: Duration::from_millis(config.flush_timeout_ms) })
    }

    /// Returns a provider that exports nothing and samples no new trace.
    fn off() -> Self {
        let provider = provider(0.0).with_resource(Resource::builder_empty().build()).build();
        Self { provider, flush_timeout: Duration::ZERO }
    }

    /// Returns the tracer of the service.
    pub(crate) fn tracer(&self) -> Tracer {
        let version = env!("CARGO_PKG_VERSION");
        let scope = InstrumentationScope::builder(env!("CARGO_PKG_NAME")).with_version(version).build();
        Tracer(self.provider.tracer_with_scope(scope))
    }

    /// Exports the queued spans, for a limited time, and stops the export.
    pub(crate) async fn shut_down(self) {
        let Self { provider, flush_timeout } = self;
        let flush = move || provider.shutdown_with_timeout(flush_timeout);
        if let Ok(Err(error)) = tokio::task::spawn_blocking(flush).await {
            tracing::warn!(%error, "the last spans were not exported");
        }
    }
}

/// Returns a builder that samples this fraction of new traces. Otherwise, the parent decides.
fn provider(sample_ratio: f64) -> TracerProviderBuilder {
    let sampler = Sampler::ParentBased(Box::new(Sampler::TraceIdRatioBased(sample_ratio)));
    SdkTracerProvider::builder().with_sampler(sampler)
}

fn exporter(config: &TelemetryConfig, endpoint: &str) -> Result<Counted, TelemetryError> {
    let failed = |reason: String| TelemetryError::Install { what: "the trace exporter", reason };
    let headers = config.secret_headers.iter().flat_map(SecretHeaders::reveal);
    let headers = headers.filter_map(|(name, value)| Some((name.to_string(), value.to_str().ok()?.to_owned())));
    let timeout = Duration::from_millis(config.timeout_ms);
    let exporter = opentelemetry_otlp::SpanExporter::builder()
        .with_http()
        .with_http_client(client(timeout, endpoint).map_err(|e| failed(format!("{e:?}")))?)
        .with_protocol(Protocol::HttpBinary)
        .with_endpoint(traces_url(endpoint))
        .with_headers(headers.collect())
        .with_timeout(timeout)
        .build();
    exporter.map(Counted).map_err(|e| failed(e.to_string()))
}

/// Returns the URL for traces of a collector with the base URL `endpoint`.
fn traces_url(endpoint: &str) -> String {
    format!("{}/v1/traces", endpoint.trim_end_matches('/'))
}

/// Builds the HTTP client of the export thread. A blocking client must not be built on a thread of the async runtime.
fn client(timeout: Duration, endpoint: &str) -> Result<Client, reqwest::Error> {
    let builder = || Client::builder().no_proxy().redirect(Policy::none()).timeout(timeout);
    let needs_tls = endpoint.starts_with("https:");
    let build = || match builder().build() {
        // Without system certificates, plain HTTP still works.
        Err(_no_certificates) if !needs_tls => builder().tls_certs_only([]).build(),
        built => built,
    };
    crate::tls::install_provider();
    thread::scope(|scope| scope.spawn(build).join()).unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// Exporter that counts the spans of each batch in a metric, by the result of the batch.
#[derive(Debug)]
struct Counted(opentelemetry_otlp::SpanExporter);

impl SpanExporter for Counted {
    async fn export(&self, batch: Vec<SpanData>) -> OTelSdkResult {
        let spans = batch.len() as u64;
        let exported = self.0.export(batch).await;
        counter!(TRACE_SPANS, "result" => if exported.is_ok() { "exported" } else { "failed" }).increment(spans);
        exported
    }

    fn set_resource(&mut self, resource: &Resource) {
        self.0.set_resource(resource);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;
    use crate::telemetry::{SpanParent, TraceSpan};
    use opentelemetry::trace::SpanKind;

    #[test]
    fn traces_have_a_path_below_the_endpoint() {
        for (endpoint, url) in [
            ("http://localhost:4318", "http://localhost:4318/v1/traces"),
            ("https://c.example/otlp/", "https://c.example/otlp/v1/traces"),
        ] {
            assert_eq!(traces_url(endpoint), url);
        }
    }

    #[test]
    fn the_sampling_ratio_applies_to_new_traces() {
        const N: usize = 10_000;
        for (ratio, expected) in [(0.0, 0..=0), (0.25, N / 5..=N * 3 / 10), (1.0, N..=N)] {
            let tracer = Tracer(provider(ratio).build().tracer("test"));
            let parent = SpanParent { tracer, ..SpanParent::default() };
            let start = || TraceSpan::start(&parent, "root", SpanKind::Internal, Instant::now());
            let sampled = (0..N).filter(|_| start().context().is_sampled()).count();
            assert!(expected.contains(&sampled), "{ratio}: {sampled}");
        }
    }
}
