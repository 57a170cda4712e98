//! Many sessions on a real server, which move a twentieth of their time each.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context as _, ensure};
use lodestream_tests::server_process::{Running, ServerProcess, client_bin, described};
use serde_json::Value;

/// How long clients go on, and over how much of that they begin.
const DURATION_S: u32 = 40;
const RAMP_S: u32 = 15;

/// What so many sessions cost.
pub(crate) struct Crowd {
    pub(crate) sessions: u32,
    pub(crate) cpu_ms_per_client_s: f64,
    pub(crate) clients_per_core: f64,
    pub(crate) resident_mb: f64,
    pub(crate) session_kb: f64,
    pub(crate) first_image_p99_ms: f64,
    pub(crate) first_op_p50_ms: f64,
    pub(crate) first_op_p99_ms: f64,
}

impl Crowd {
    pub(crate) const HEAD: &str = "| sessions | server time, ms per client-second | clients per core | resident, MB | kB per session | first image, p99, ms | view to first op, p50, ms | p99, ms |";

    pub(crate) fn row(&self) -> String {
        let Self { sessions, cpu_ms_per_client_s, clients_per_core, resident_mb, session_kb, .. } = self;
        let Self { first_image_p99_ms, first_op_p50_ms, first_op_p99_ms, .. } = self;
        format!(
            "| {sessions} | {cpu_ms_per_client_s:.2} | {clients_per_core:.0} | {resident_mb:.0} | {session_kb:.0} | {first_image_p99_ms:.0} | {first_op_p50_ms:.1} | {first_op_p99_ms:.0} |"
        )
    }

    /// A fresh server, and `lodestream load` on the same machine.
    pub(crate) fn measure(repository: &Path, model: &str, sessions: u32) -> anyhow::Result<Self> {
        let process = ServerProcess::start_with(repository, &[("LODESTREAM_RUNTIME_MAX_SESSIONS", "4000")]);
        let url = process.url(model);
        let [clients, duration, ramp] =
            [sessions.to_string(), (DURATION_S).to_string(), format!("{}s", if sessions == 1 { 0 } else { RAMP_S })];
        let words = ["load", &url, "--json", "-", "--clients", &clients, "--duration", &duration, "--ramp", &ramp];
        let words = [&words[..], &["--triangles", "5000", "--duty", "0.05", "--path", "orbit"]].concat();
        let limit = Duration::from_secs(u64::from(DURATION_S + RAMP_S) + 120);
        let output = Running::start(&client_bin(), &words).wait(limit);
        ensure!(output.status.success(), "{sessions} sessions: {}", described(&output));
        let report: Value = serde_json::from_slice(&output.stdout).context("--json prints JSON")?;
        let number = |pointer: &str| {
            let value = report.pointer(pointer).and_then(Value::as_f64);
            value.with_context(|| format!("the report has no {pointer}"))
        };
        let completed = number("/clients/completed")?;
        ensure!(completed == f64::from(sessions), "{completed} of {sessions} clients came to their end");
        ensure!(number("/limits_exceeded")? == 0.0 && number("/resets")? == 0.0, "a limit or a mesh did not hold");
        Ok(Self {
            sessions,
            cpu_ms_per_client_s: number("/server/cpu_s_per_client_s")? * 1e3,
            clients_per_core: number("/server/clients_per_core")?,
            resident_mb: number("/server/resident_bytes_peak")? / 1e6,
            session_kb: number("/server/session_bytes_per_session")? / 1e3,
            first_image_p99_ms: number("/first_image_ms/p99")?,
            first_op_p50_ms: number("/view_to_first_op_ms/p50")?,
            first_op_p99_ms: number("/view_to_first_op_ms/p99")?,
        })
    }
}
