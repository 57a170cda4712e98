//! What is asked of the server: the hello, and views under the limits in force.

use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::View;

use super::Viewer;
use super::governor::AUTO_IMAGES_PER_S;
use super::settings::Auto;
use crate::camera::{Camera, Detail};
use crate::core::ClientConfig;
use glam::DVec3;

/// Bytes that a triangle takes: mesh and cache in memory, buffers of the GPU. Measured at 1 M triangles, rounded up.
const BYTES_PER_TRIANGLE: u64 = 160;
/// Bytes of ops that may wait to be applied: more than a server sends without acknowledgement.
const INBOX_BYTES: usize = 16 << 20;

/// What settings that are left to the program come to at present.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Automatic {
    /// Most triangles.
    pub triangles: u32,
    /// Largest error that may stay, in pixels.
    pub tolerance_px: f32,
    /// Images per second that the triangles are chosen for; more are drawn if the machine can.
    pub images_per_s: f32,
    /// Memory for the mesh, in MiB.
    pub memory_mib: u32,
}

impl Viewer {
    /// What automatic settings come to. The rate of bytes has no limit then.
    pub fn automatic(&self) -> Automatic {
        Automatic {
            triangles: self.triangle_limit(),
            tolerance_px: self.tolerance_px(),
            images_per_s: AUTO_IMAGES_PER_S,
            memory_mib: self.options.auto_memory_mib,
        }
    }

    pub(super) fn session_config(&self) -> ClientConfig {
        ClientConfig {
            triangle_limit: self.triangle_ceiling(),
            byte_rate: self.settings.byte_rate.fixed(),
            apply_on_arrival: false,
            inbox_bytes: INBOX_BYTES,
            reconnect_seed: self.options.seed,
            ..ClientConfig::default()
        }
    }

    pub(super) fn clip_planes(&self) -> Vec<[f64; 4]> {
        let Some((section, model)) = self.settings.section.zip(self.model()) else { return Vec::new() };
        let corner = |q| DVec3::from_array(model.lattice.position(q));
        vec![section.plane(corner(model.box_min), corner(model.box_max))]
    }

    /// The limit if images are quick enough: of the settings, of memory.
    pub(super) fn triangle_ceiling(&self) -> u32 {
        let memory_mib = self.settings.memory_mib.fixed().unwrap_or(self.options.auto_memory_mib);
        let by_memory = (u64::from(memory_mib) << 20) / BYTES_PER_TRIANGLE;
        let by_setting = self.settings.triangles.fixed().unwrap_or(self.options.auto_triangles);
        by_setting.min(u32::try_from(by_memory).unwrap_or(u32::MAX))
    }

    /// The limit of the next view.
    pub(super) fn triangle_limit(&self) -> u32 {
        let by_rate = match self.settings.triangles {
            Auto::Auto => self.governor.limit(),
            Auto::Fixed(_) => u32::MAX,
        };
        let smallest = match self.session.model() {
            Some(model) => model.smallest_limit,
            None => self.options.hint.map_or(0, |hint| hint.smallest_limit),
        };
        self.triangle_ceiling().min(by_rate).max(smallest)
    }

    pub(super) fn update_view(&mut self, now: Timestamp) {
        // Without the model's smallest limit a view may be refused.
        if self.session.model().is_none() && self.options.hint.is_none() {
            return;
        }
        let Some(navigator) = &self.navigator else { return };
        let view = self.view(&self.frozen.unwrap_or_else(|| navigator.camera()));
        let before = self.session.view().map(|(seq, _)| seq);
        // A camera at the edge of what numbers can hold gives no view; the one before stays.
        if let Ok(seq) = self.session.set_view(now, view)
            && before != Some(seq)
        {
            if let Some(latency) = self.session.stats().view_latency_ms {
                self.figures.round_trip_ms = Some(latency);
            }
            self.progress.begin();
        }
    }

    pub(super) fn view(&self, camera: &Camera) -> View {
        let detail = Detail {
            triangle_limit: self.triangle_limit(),
            tolerance_px: self.tolerance_px(),
            complete: false,
            two_sided: self.model().is_some_and(|model| model.is_open) || self.settings.section.is_some(),
        };
        let mut view = camera.view(self.options.viewport, &detail);
        view.clip_planes = self.clip_planes();
        view
    }

    /// Automatic: a point of the screen.
    pub(super) fn tolerance_px(&self) -> f32 {
        self.settings.tolerance_px.fixed().unwrap_or(self.options.pixels_per_point.max(1.0) as f32)
    }
}
