//! What the server says about itself: its page of metrics, read before, during and after a run.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;
use tokio::time::Instant;

use crate::net::native::get::{GetError, get};
use crate::net::target::Target;

/// Longest page that is read.
const MAX_PAGE_BYTES: usize = 1 << 20;
/// How long the server may take to answer.
const TIMEOUT: Duration = Duration::from_secs(5);
/// Time between two readings.
pub(super) const READING_INTERVAL: Duration = Duration::from_secs(1);
/// Readings that are kept; when there are more, every other one goes.
const MAX_READINGS: usize = 1024;

/// Why there are no figures of the server.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MetricsError {
    /// No page.
    #[error("{path} of the server cannot be read")]
    Get {
        /// Of the page.
        path: String,
        /// Why not.
        source: GetError,
    },
    /// The page is not in the text format of Prometheus. Lines count from 1.
    #[error("metrics of the server, line {line}: {reason}")]
    Line {
        /// Where.
        line: usize,
        /// What is wrong there.
        reason: &'static str,
    },
    /// The page is no text.
    #[error("metrics of the server are no text")]
    NoText,
    /// Another server, or another version.
    #[error("metrics of the server have no {0} that makes sense")]
    Missing(&'static str),
    /// A counter fell.
    #[error("the server was started anew during the run")]
    Restarted,
}

/// One reading.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Reading {
    /// Seconds since the run began.
    pub at_s: f64,
    /// Processor time that the server's process has used, in seconds.
    pub cpu_s: f64,
    /// Its resident memory in bytes, 0 where the server does not know it.
    pub resident_bytes: f64,
    /// Memory of all sessions in bytes, by their own account.
    pub session_bytes: f64,
    /// Sessions.
    pub sessions: f64,
    /// Streams refused since the server began.
    pub refused: f64,
    /// Resets since then.
    pub resets: f64,
    /// Bytes of batches sent a second time since then.
    pub sent_again_bytes: f64,
}

impl Reading {
    fn of(at: Duration, page: &[u8]) -> Result<Self, MetricsError> {
        let sums = sums(std::str::from_utf8(page).map_err(|_| MetricsError::NoText)?)?;
        let sum = |name: &'static str| {
            let value = sums.get(name).copied().filter(|value| value.is_finite() && *value >= 0.0);
            value.ok_or(MetricsError::Missing(name))
        };
        Ok(Self {
            at_s: at.as_secs_f64(),
            cpu_s: sum("process_cpu_seconds_total")?,
            resident_bytes: sum("process_resident_memory_bytes")?,
            session_bytes: sum("lodestream_session_memory_bytes")?,
            sessions: sum("lodestream_sessions")?,
            refused: sum("lodestream_refused_total")?,
            resets: sum("lodestream_resets_total")?,
            sent_again_bytes: sum("lodestream_sent_again_bytes_total")?,
        })
    }
}

/// Sum over all labels of each metric of a page (Prometheus text format 0.0.4). Names are kept as they are; O(n log n).
fn sums(page: &str) -> Result<BTreeMap<&str, f64>, MetricsError> {
    let mut sums = BTreeMap::new();
    for (number, line) in (1..).zip(page.lines()) {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let (name, value) = sample(line).map_err(|reason| MetricsError::Line { line: number, reason })?;
        *sums.entry(name).or_insert(0.0) += value;
    }
    Ok(sums)
}

/// Name and value of a line `name{label="text",...} value [timestamp]`.
fn sample(line: &str) -> Result<(&str, f64), &'static str> {
    let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == ':';
    let (name, mut rest) = line.split_at(line.find(|c| !is_name(c)).unwrap_or(line.len()));
    if name.is_empty() || name.starts_with(|c: char| c.is_ascii_digit()) {
        return Err("it begins with no name");
    }
    if let Some(labels) = rest.strip_prefix('{') {
        rest = &labels[labels_len(labels).ok_or("labels do not end")?..];
    }
    let mut words = rest.split_whitespace();
    let value = words.next().and_then(|word| word.parse().ok()).ok_or("no number follows the name")?;
    let is_timestamp = words.next().is_none_or(|word| word.parse::<i64>().is_ok());
    if is_timestamp && words.next().is_none() { Ok((name, value)) } else { Err("something follows the number") }
}

/// Bytes up to behind the brace that closes the labels; braces in quoted text do not count.
fn labels_len(labels: &str) -> Option<usize> {
    let (mut is_quoted, mut is_escaped) = (false, false);
    for (at, byte) in labels.bytes().enumerate() {
        match byte {
            _ if is_escaped => is_escaped = false,
            b'\\' => is_escaped = is_quoted,
            b'"' => is_quoted = !is_quoted,
            b'}' if !is_quoted => return Some(at + 1),
            _ => {}
        }
    }
    None
}

/// What the server used for the run: everything it did meanwhile, other clients and the reading of metrics included.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ServerFigures {
    /// Processor time from the first reading to the last, in seconds.
    pub cpu_s: f64,
    /// The same for each client that got a stream.
    pub cpu_s_per_client: Option<f64>,
    /// The same for each second that a client had a stream.
    pub cpu_s_per_client_s: Option<f64>,
    /// Clients that one core carries: one over that.
    pub clients_per_core: Option<f64>,
    /// Resident memory before the run in bytes.
    pub resident_bytes_before: f64,
    /// The most that a reading saw.
    pub resident_bytes_peak: f64,
    /// After it.
    pub resident_bytes_after: f64,
    /// Most sessions that a reading saw.
    pub sessions_peak: f64,
    /// What they held then, in bytes.
    pub session_bytes: f64,
    /// The same for each of them.
    pub session_bytes_per_session: Option<f64>,
    /// Streams refused during the run, whoever asked.
    pub refused: f64,
    /// Resets during the run.
    pub resets: f64,
    /// Bytes of batches sent a second time during the run, over connections that took the place of broken ones.
    pub sent_again_bytes: f64,
    /// What was read, about once a second.
    pub readings: Vec<Reading>,
}

impl ServerFigures {
    pub(super) fn new(readings: Vec<Reading>, clients: u64, client_time: Duration) -> Result<Self, MetricsError> {
        let ratio = |a: f64, b: f64| (b > 0.0).then(|| a / b).filter(|ratio| ratio.is_finite());
        let (Some(first), Some(last)) = (readings.first(), readings.last()) else {
            return Err(MetricsError::Missing("reading"));
        };
        let has_fallen = |of: fn(&Reading) -> f64| readings.windows(2).any(|pair| of(&pair[1]) < of(&pair[0]));
        if has_fallen(|reading| reading.cpu_s)
            || has_fallen(|reading| reading.refused)
            || has_fallen(|reading| reading.resets)
            || has_fallen(|reading| reading.sent_again_bytes)
        {
            return Err(MetricsError::Restarted);
        }
        // Of several with as many sessions the last: they have come farthest.
        let fullest = readings.iter().max_by(|a, b| a.sessions.total_cmp(&b.sessions)).unwrap_or(last);
        let cpu_s = last.cpu_s - first.cpu_s;
        let per_client_s = ratio(cpu_s, client_time.as_secs_f64());
        Ok(Self {
            cpu_s,
            cpu_s_per_client: ratio(cpu_s, clients as f64),
            cpu_s_per_client_s: per_client_s,
            clients_per_core: per_client_s.and_then(|cpu| ratio(1.0, cpu)),
            resident_bytes_before: first.resident_bytes,
            resident_bytes_peak: readings.iter().map(|reading| reading.resident_bytes).fold(0.0, f64::max),
            resident_bytes_after: last.resident_bytes,
            sessions_peak: fullest.sessions,
            session_bytes: fullest.session_bytes,
            session_bytes_per_session: ratio(fullest.session_bytes, fullest.sessions),
            refused: last.refused - first.refused,
            resets: last.resets - first.resets,
            sent_again_bytes: last.sent_again_bytes - first.sent_again_bytes,
            readings,
        })
    }
}

/// Reads the page again and again.
#[derive(Debug)]
pub(super) struct Reader {
    target: Target,
    start: Instant,
    readings: Vec<Reading>,
    /// The first time that it went wrong; later ones in between do not count.
    failure: Option<MetricsError>,
}

impl Reader {
    pub(super) fn new(target: &Target, start: Instant) -> Self {
        Self { target: target.clone(), start, readings: Vec::new(), failure: None }
    }

    /// One reading.
    ///
    /// # Errors
    /// [`MetricsError`].
    async fn read(&self) -> Result<Reading, MetricsError> {
        let path = self.target.metrics_path();
        let page = get(&self.target, &path, MAX_PAGE_BYTES, TIMEOUT).await;
        // The server has counted by now what the page says.
        let at = self.start.elapsed();
        Reading::of(at, &page.map_err(|source| MetricsError::Get { path, source })?)
    }

    fn keep(&mut self, reading: Reading) {
        if self.readings.len() >= MAX_READINGS {
            let mut number = 0;
            self.readings.retain(|_| {
                number += 1;
                number % 2 == 1
            });
        }
        self.readings.push(reading);
    }

    /// The first reading.
    pub(super) async fn begin(&mut self) {
        match self.read().await {
            Ok(reading) => self.keep(reading),
            Err(error) => self.failure = Some(error),
        }
    }

    /// Readings until `stop` is notified. A server that is too busy to answer one gives fewer of them.
    pub(super) async fn go_on(mut self, stop: std::sync::Arc<tokio::sync::Notify>) -> Self {
        let mut ticks = tokio::time::interval(READING_INTERVAL);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        ticks.tick().await;
        while self.failure.is_none() {
            tokio::select! {
                biased;
                () = stop.notified() => break,
                _ = ticks.tick() => if let Ok(reading) = self.read().await {
                    self.keep(reading);
                },
            }
        }
        self
    }

    /// The last reading, and what follows from all.
    ///
    /// # Errors
    /// [`MetricsError`] of the first reading or the last.
    pub(super) async fn end(mut self, clients: u64, client_time: Duration) -> Result<ServerFigures, MetricsError> {
        if let Some(failure) = self.failure.take() {
            return Err(failure);
        }
        let last = self.read().await?;
        self.readings.push(last);
        ServerFigures::new(self.readings, clients, client_time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAGE: &str = "# HELP lodestream_sessions Sessions by state.\n# TYPE lodestream_sessions gauge\n\
        lodestream_sessions{state=\"moving\"} 3\nlodestream_sessions{state=\"resting\"} 2 1700000000000\n\n\
        lodestream_session_memory_bytes 5e6\nlodestream_refused_total{reason=\"a } \\\" \\\\\",x=\"\"} 1\n\
        lodestream_resets_total 0\nlodestream_sent_again_bytes_total 4096\nlodestream_view_seconds_bucket{le=\"+Inf\"} +Inf\n\
        process_cpu_seconds_total 12.5\nprocess_resident_memory_bytes 1e8\n";

    #[test]
    fn a_page_is_read() {
        let reading = Reading::of(Duration::from_millis(1500), PAGE.as_bytes()).unwrap();
        let expected = Reading {
            at_s: 1.5,
            cpu_s: 12.5,
            resident_bytes: 1e8,
            session_bytes: 5e6,
            sessions: 5.0,
            refused: 1.0,
            resets: 0.0,
            sent_again_bytes: 4096.0,
        };
        assert_eq!(reading, expected);
    }

    #[test]
    fn other_pages_are_refused_with_the_reason() {
        let check = |page: &[u8], reason: &str| {
            let error = Reading::of(Duration::ZERO, page).unwrap_err().to_string();
            assert!(error.contains(reason), "{error}");
        };
        check(b"", "no process_cpu_seconds_total");
        check(b"\xff\xfe", "no text");
        check(b"<html>", "line 1: it begins with no name");
        check(b"# x\n3 4\n", "line 2: it begins with no name");
        check(b"x\n", "no number");
        check(b"x{a=\"b\"}\n", "no number");
        check(b"x{a=\"}\n", "do not end");
        check(b"x{a=\"\\\"} 1\n", "do not end");
        check(b"x 1 2 3\n", "something follows");
        check(b"x 1 y\n", "something follows");
        for value in ["NaN", "-1", "+Inf"] {
            let page = PAGE.replace("total 12.5", &format!("total {value}"));
            check(page.as_bytes(), "no process_cpu_seconds_total that makes sense");
        }
    }

    #[test]
    fn no_page_is_too_much() {
        let mut rng = fastrand::Rng::with_seed(4);
        let mut refused = 0;
        for _ in 0..5_000 {
            let mut page = PAGE.as_bytes().to_vec();
            for _ in 0..rng.usize(1..6) {
                let at = rng.usize(..page.len());
                page[at] = *rng.choice(b"{}\"\\ \n#x9\xc3").unwrap();
            }
            page.truncate(rng.usize(..=page.len()));
            refused += u32::from(Reading::of(Duration::ZERO, &page).is_err());
        }
        assert!(refused > 1000, "{refused}");
    }

    #[test]
    fn figures_follow_from_readings() {
        let reading = |at_s: f64, cpu_s: f64, sessions: f64| Reading {
            at_s,
            cpu_s,
            sessions,
            session_bytes: sessions * 1e5 + at_s,
            resident_bytes: 1e7 + cpu_s,
            ..Reading::default()
        };
        let readings =
            vec![reading(0.0, 1.0, 0.0), reading(1.0, 2.0, 4.0), reading(2.0, 2.5, 4.0), reading(3.0, 3.0, 1.0)];
        let figures = ServerFigures::new(readings.clone(), 4, Duration::from_secs(8)).unwrap();
        assert_eq!((figures.cpu_s, figures.cpu_s_per_client, figures.cpu_s_per_client_s), (2.0, Some(0.5), Some(0.25)));
        assert_eq!((figures.clients_per_core, figures.sessions_peak), (Some(4.0), 4.0));
        assert_eq!(figures.session_bytes_per_session, Some((4e5 + 2.0) / 4.0), "the later of two as full");
        let none = ServerFigures::new(readings.clone(), 0, Duration::ZERO).unwrap();
        assert_eq!((none.cpu_s_per_client, none.clients_per_core), (None, None));
        let mut restarted = readings;
        restarted[2].cpu_s = 0.1;
        assert!(matches!(ServerFigures::new(restarted, 4, Duration::ZERO), Err(MetricsError::Restarted)));
    }
}
