//! Configuration of the log.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Format of log lines.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// Text for terminals.
    #[default]
    Pretty,
    /// One JSON object per line, for log collectors.
    Json,
}

section! {
    /// Log, written to standard error.
    LogConfig;
    /// Filter of log lines, as `level` or `target=level,…`. Default `info`: one line per request.
    filter: String = "info".to_owned();
    /// Format of log lines, `pretty` or `json`. Default `pretty`, which is readable on a terminal.
    format: LogFormat = LogFormat::default();
}
