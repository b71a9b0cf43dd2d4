//! Reports of commands: text on stderr, or JSON on stdout.

use std::io::{self, Write as _};

use molmesh::structure::strict_validator::Diagnostic;
use serde::Serialize;
use serde_json::{Value, json};

use super::args::{ReportStyle, RunArgs};
use super::error::CliError;
use super::page::grouped;
use super::style::printable;

/// Written file.
pub(crate) struct WrittenFile {
    /// Member of the JSON report.
    pub(crate) member: &'static str,
    /// Path, or `stdout`.
    pub(crate) name: String,
    /// Format.
    pub(crate) format: &'static str,
    /// Bytes.
    pub(crate) bytes: u64,
    /// True if the file is on stdout.
    pub(crate) is_stdout: bool,
}

impl WrittenFile {
    /// Returns the file as text.
    pub(super) fn text(&self) -> String {
        format!("{} ({}, {} bytes)", printable(&self.name), self.format, grouped(self.bytes))
    }
}

/// Report of a command whose files are complete.
pub(super) struct CommandReport<R> {
    pub(super) report: R,
    /// Files that the JSON report lists.
    pub(super) files: Vec<WrittenFile>,
    /// Findings of the strict validator, if it ran.
    pub(super) findings: Option<Vec<Diagnostic>>,
}

impl<R: Serialize> CommandReport<R> {
    /// Writes the report: `text` to stderr unless it is unwanted, JSON to stdout, or to stderr if a file is on stdout.
    pub(super) fn write(&self, run: &RunArgs, text: impl FnOnce(&Self) -> String) -> Result<(), CliError> {
        match run.report {
            ReportStyle::Text if run.quiet => {}
            // The files are finished, so a closed stderr is not an error.
            ReportStyle::Text => drop(io::stderr().write_all(text(self).as_bytes())),
            ReportStyle::Json => {
                let text = json_text(&self.document()?);
                if !self.files.iter().any(|file| file.is_stdout) {
                    return super::print(&text);
                }
                let printed = io::stderr().write_all(text.as_bytes());
                printed.map_err(|source| CliError::Output { name: "stderr".to_owned(), source })?;
            }
        }
        Ok(())
    }

    /// Returns the JSON report.
    pub(super) fn document(&self) -> Result<Value, CliError> {
        let failed = |error| CliError::Internal(format!("the report cannot be serialized: {error}"));
        let mut document = serde_json::to_value(&self.report).map_err(failed)?;
        for WrittenFile { member, name, format, bytes, .. } in &self.files {
            document[member] = json!({ "file": name, "format": format, "bytes": bytes });
        }
        if let Some(findings) = &self.findings {
            let finding = |f: &Diagnostic| json!({ "level": f.level.name(), "message": f.message, "line": f.line });
            document["findings"] = findings.iter().map(finding).collect();
        }
        Ok(document)
    }
}

/// Formats a document for output.
pub(super) fn json_text(document: &Value) -> String {
    format!("{document:#}\n")
}

/// Formats a finding of the strict validator on one line.
pub(super) fn finding(finding: &Diagnostic) -> String {
    let place = finding.line.map(|n| format!("line {n}: ")).unwrap_or_default();
    format!("{place}{}", finding.message.split_whitespace().collect::<Vec<_>>().join(" "))
}
