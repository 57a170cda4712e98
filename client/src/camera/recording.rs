//! The views of a session as a file, to be replayed: JSON, one object per line.
//!
//! The first line says what follows, `{"lodestream_path": 1}`; every other line is a view:
//!
//! `{"time": 0.25, "eye": [1.0, 0.5, 4.0], "target": [0.0, 0.5, 0.0], "fov": 45.0, "tolerance": 1.0}`
//!
//! `time` is in seconds since the recording began and never falls; `eye` and `target` are in model units and differ; `fov` is
//! the vertical opening angle in degrees; `tolerance`, in pixels, may be left out and is then the replayer's. Up is +y. Other
//! fields are refused, so that a version that knows more of them has to say so. Empty lines are skipped.

use std::fmt;
use std::io::{self, BufRead, Read as _, Write};
use std::time::Duration;

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Version of the format.
pub const RECORDING_VERSION: u32 = 1;
/// Most views of a recording: ten hours at 60 a second, some 200 MB in memory.
pub const MAX_RECORDED_VIEWS: usize = 1 << 21;
/// Longest line in bytes: numbers take 25 at most.
const MAX_LINE_BYTES: u64 = 1024;

/// One view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordedView {
    /// Seconds since the recording began.
    #[serde(rename = "time")]
    pub time_s: f64,
    /// Camera position in model units.
    pub eye: DVec3Text,
    /// Point looked at in model units.
    pub target: DVec3Text,
    /// Vertical opening angle in degrees.
    #[serde(rename = "fov")]
    pub fov_deg: f32,
    /// Largest error that may stay, in pixels.
    #[serde(rename = "tolerance", default, skip_serializing_if = "Option::is_none")]
    pub tolerance_px: Option<f32>,
}

/// A point as it stands in the file.
pub type DVec3Text = [f64; 3];

impl RecordedView {
    /// Time since the recording began.
    pub fn time(&self) -> Duration {
        Duration::from_secs_f64(self.time_s)
    }

    fn check(&self) -> Result<(), &'static str> {
        let is_point = |point: DVec3Text| point.iter().all(|x| x.is_finite());
        let checks = [
            ((0.0..=1e7).contains(&self.time_s), "time is not from 0 to 10,000,000 seconds"),
            (is_point(self.eye) && is_point(self.target), "eye and target must be finite"),
            (DVec3::from_array(self.eye) != DVec3::from_array(self.target), "eye and target are the same point"),
            ((0.001..=179.0).contains(&self.fov_deg), "fov is not from 0.001 to 179 degrees"),
            (
                self.tolerance_px.is_none_or(|px| (0.0..=1e6).contains(&px)),
                "tolerance is not from 0 to 1,000,000 pixels",
            ),
        ];
        checks.iter().find(|(ok, _)| !ok).map_or(Ok(()), |(_, text)| Err(text))
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    lodestream_path: u32,
}

/// Why a file is no recording. Lines count from 1.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// The file cannot be read.
    #[error("it cannot be read")]
    Io(#[from] io::Error),
    /// The first line is not that of a recording.
    #[error("it is no recording of views: line 1 is not {{\"lodestream_path\": {RECORDING_VERSION}}}")]
    NoHeader,
    /// Another version.
    #[error("it is a recording of version {0}, this program reads {RECORDING_VERSION}")]
    Version(u32),
    /// A line that is no view.
    #[error("line {line}: {reason}")]
    Line {
        /// Which.
        line: usize,
        /// What is wrong.
        reason: String,
    },
    /// No view at all.
    #[error("it has no views")]
    Empty,
}

/// Views in the order of their times, at least one.
#[derive(Clone, PartialEq)]
pub struct Recording {
    views: Vec<RecordedView>,
}

impl fmt::Debug for Recording {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Recording of {} views", self.views.len())
    }
}

impl Recording {
    /// Reads a recording. Memory grows with the views read, never with what a line claims.
    ///
    /// # Errors
    /// [`RecordingError`] says which line is wrong, and why.
    pub fn read(mut input: impl BufRead) -> Result<Self, RecordingError> {
        let mut line = Vec::new();
        let mut views: Vec<RecordedView> = Vec::new();
        for number in 1.. {
            line.clear();
            let refuse = |reason: String| RecordingError::Line { line: number, reason };
            if input.by_ref().take(MAX_LINE_BYTES + 1).read_until(b'\n', &mut line)? == 0 {
                break;
            }
            if line.len() as u64 > MAX_LINE_BYTES {
                return Err(match number {
                    1 => RecordingError::NoHeader,
                    _ => refuse(format!("longer than {MAX_LINE_BYTES} bytes")),
                });
            }
            let text = line.trim_ascii();
            if number == 1 {
                let header: Header = serde_json::from_slice(text).map_err(|_| RecordingError::NoHeader)?;
                if header.lodestream_path != RECORDING_VERSION {
                    return Err(RecordingError::Version(header.lodestream_path));
                }
                continue;
            }
            if text.is_empty() {
                continue;
            }
            let view: RecordedView = serde_json::from_slice(text).map_err(|error| refuse(error.to_string()))?;
            view.check().map_err(|reason| refuse(reason.into()))?;
            if views.last().is_some_and(|before| before.time_s > view.time_s) {
                return Err(refuse("time falls".into()));
            }
            if views.len() == MAX_RECORDED_VIEWS {
                return Err(refuse(format!("more than {MAX_RECORDED_VIEWS} views")));
            }
            views.push(view);
        }
        if views.is_empty() { Err(RecordingError::Empty) } else { Ok(Self { views }) }
    }

    /// Time of the last view.
    pub fn duration(&self) -> Duration {
        self.views.last().map_or(Duration::ZERO, RecordedView::time)
    }

    /// All views.
    pub fn views(&self) -> &[RecordedView] {
        &self.views
    }
}

/// Writes the line that begins a recording.
///
/// # Errors
/// What `out` says.
pub fn write_header(out: &mut impl Write) -> io::Result<()> {
    serde_json::to_writer(&mut *out, &Header { lodestream_path: RECORDING_VERSION })?;
    out.write_all(b"\n")
}

/// Writes a view as a line.
///
/// # Errors
/// What `out` says.
pub fn write_view(out: &mut impl Write, view: &RecordedView) -> io::Result<()> {
    serde_json::to_writer(&mut *out, view)?;
    out.write_all(b"\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Recording, RecordingError> {
        Recording::read(text.as_bytes())
    }

    #[test]
    fn what_is_written_is_read_again() {
        let views = [
            RecordedView {
                time_s: 0.0,
                eye: [0.1, -2e6, 3.0],
                target: [0.0; 3],
                fov_deg: 45.0,
                tolerance_px: Some(0.5),
            },
            RecordedView { time_s: 0.25, eye: [1.0; 3], target: [0.0; 3], fov_deg: 30.5, tolerance_px: None },
        ];
        let mut bytes = Vec::new();
        write_header(&mut bytes).unwrap();
        views.iter().for_each(|view| write_view(&mut bytes, view).unwrap());
        assert_eq!(Recording::read(&bytes[..]).unwrap().views(), views);
        let expected = "{\"lodestream_path\":1}\n\
            {\"time\":0.0,\"eye\":[0.1,-2000000.0,3.0],\"target\":[0.0,0.0,0.0],\"fov\":45.0,\"tolerance\":0.5}\n\
            {\"time\":0.25,\"eye\":[1.0,1.0,1.0],\"target\":[0.0,0.0,0.0],\"fov\":30.5}\n";
        assert_eq!(String::from_utf8(bytes).unwrap(), expected);
    }

    #[test]
    fn what_is_wrong_is_named_with_its_line() {
        let view = r#"{"time": 1, "eye": [1, 2, 3], "target": [0, 0, 0], "fov": 45}"#;
        let header = "{\"lodestream_path\": 1}\n";
        assert_eq!(read(&format!("{header}\n{view}\r\n\n{view}")).unwrap().views().len(), 2);
        let message = |text: &str| read(text).unwrap_err().to_string();
        for (text, words) in [
            (String::new(), "no views"),
            (header.into(), "no views"),
            (view.into(), "line 1 is not {\"lodestream_path\": 1}"),
            ("\u{0}".repeat(5000), "line 1 is not"),
            ("{\"lodestream_path\": 2}".into(), "version 2"),
            (format!("{header}{view}\n{}", view.replace("\"time\": 1", "\"time\": 0.5")), "line 3: time falls"),
            (format!("{header}{}", view.replace("45", "180")), "line 2: fov"),
            (format!("{header}{}", view.replace("[1, 2, 3]", "[0, 0, 0]")), "line 2: eye and target are the same"),
            (format!("{header}{}", view.replace("[1, 2, 3]", "[1, 2]")), "line 2: "),
            (format!("{header}{}", view.replace("1, 2, 3", "1e999, 2, 3")), "line 2: "),
            (format!("{header}{}", view.replace("fov", "fow")), "line 2: unknown field `fow`"),
            (format!("{header}{}{view}", " ".repeat(2000)), "line 2: longer than 1024"),
        ] {
            assert!(message(&text).contains(words), "{text:?}: {}", message(&text));
        }
    }

    #[test]
    fn any_bytes_are_safe() {
        let mut rng = fastrand::Rng::with_seed(9);
        let view = r#"{"time": 1, "eye": [1, 2, 3], "target": [0, 0, 0], "fov": 45}"#;
        let text = format!("{{\"lodestream_path\": 1}}\n{view}\n{view}\n");
        let mut accepted = 0;
        for _ in 0..20_000 {
            let mut bytes = text.clone().into_bytes();
            for _ in 0..rng.usize(1..4) {
                let at = rng.usize(..bytes.len());
                bytes[at] = rng.u8(..);
            }
            accepted += u32::from(Recording::read(&bytes[..]).is_ok());
        }
        assert!(accepted > 0, "some digits change to others");
    }
}
