//! `lodestream view --play`: a recording that plays by itself once all detail is there, and what its images cost.

use lodestream_protocol::time::Timestamp;
use serde::Serialize;

use super::super::viewer::command::Command;
use super::super::viewer::figures::Figures;
use super::super::viewer::state::State;
use super::super::viewer::{Viewer, ViewerOptions};
use crate::camera::Viewport;

/// Most intervals that are kept: hours of images.
const MAX_INTERVALS: usize = 1 << 20;

/// What the images of a recording cost.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PlayReport {
    /// Images shown while it played.
    pub images: usize,
    /// Milliseconds from one image to the next: half of them are at most this.
    pub interval_p50_ms: f64,
    /// 99 of 100 are at most this.
    pub interval_p99_ms: f64,
    /// The longest.
    pub interval_most_ms: f64,
    /// Most ops applied for one image.
    pub most_applied_ops: u32,
    /// Most bytes uploaded for one image, whole meshes aside.
    pub most_uploaded_bytes: u64,
    /// Bytes that may be.
    pub allowance_bytes: u64,
    /// Images that took more.
    pub images_over_allowance: u32,
    /// Most triangles on screen.
    pub most_triangles: u32,
    /// What draws.
    pub device: String,
}

/// A recording on its way from waiting to played.
#[derive(Debug)]
pub(super) struct Rehearsal {
    file: Option<Vec<u8>>,
    last: Option<Timestamp>,
    intervals_ms: Vec<f64>,
    most_triangles: u32,
}

impl Rehearsal {
    pub(super) fn new(file: Vec<u8>) -> Self {
        Self { file: Some(file), last: None, intervals_ms: Vec::new(), most_triangles: 0 }
    }

    /// Begins to play when the viewer has all detail.
    pub(super) fn poll(&mut self, now: Timestamp, viewer: &mut Viewer) {
        if let State::Settled { .. } = viewer.state()
            && let Some(file) = self.file.take()
        {
            viewer.command(now, Command::Play(file));
        }
    }

    /// Whether it has been played.
    pub(super) fn is_over(&self, viewer: &Viewer) -> bool {
        self.file.is_none() && !viewer.is_playing()
    }

    /// An image was shown.
    pub(super) fn note_image(&mut self, now: Timestamp, viewer: &mut Viewer) {
        if !viewer.is_playing() {
            return;
        }
        if let Some(last) = self.last.replace(now)
            && self.intervals_ms.len() < MAX_INTERVALS
        {
            self.intervals_ms.push(now.since(last).as_secs_f64() * 1e3);
        }
        self.most_triangles = self.most_triangles.max(viewer.figures(now).triangles);
    }

    /// `None` if there was no image at all.
    pub(super) fn report(mut self, figures: &Figures, device: &str) -> Option<PlayReport> {
        self.intervals_ms.sort_by(f64::total_cmp);
        let most = *self.intervals_ms.last()?;
        let share = |share: f64| self.intervals_ms[(share * (self.intervals_ms.len() - 1) as f64) as usize];
        Some(PlayReport {
            images: self.intervals_ms.len() + 1,
            interval_p50_ms: share(0.5),
            interval_p99_ms: share(0.99),
            interval_most_ms: most,
            most_applied_ops: figures.most_applied_ops,
            most_uploaded_bytes: figures.most_uploaded_bytes,
            allowance_bytes: ViewerOptions::new(Viewport { width_px: 1, height_px: 1 }).upload_allowance,
            images_over_allowance: figures.images_over_allowance,
            most_triangles: self.most_triangles,
            device: device.into(),
        })
    }
}
