//! A second session that refines the neighbourhood of one ray completely, so that picking answers exactly.
//!
//! Asking for that in the viewer's own session would coarsen everything else that is on screen. A ray's neighbourhood is a
//! thin pyramid: some thousands of ops. The connection is kept for a while, since one pick is often followed by another.

use std::collections::VecDeque;
use std::time::Duration;

use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::{Projection, View};

use super::pick::{Hit, first_hit};
use crate::camera::ray::Ray;
use crate::camera::{Camera, Detail, Viewport};
use crate::core::{ClientConfig, ClientError, ClientSession};

/// Triangles that the neighbourhood of a ray may have. What the limit keeps out makes the answer inexact.
const TRIANGLES: u32 = 60_000;
/// Pixels of the viewer's image that the pyramid spans.
const SPAN_PX: f64 = 3.0;
/// Height of the probe's image.
const HEIGHT_PX: u32 = 3;
/// How long an unused connection is kept.
const KEPT: Duration = Duration::from_secs(20);
/// How long an answer may take.
const PATIENCE: Duration = Duration::from_secs(20);
/// Rays that wait.
const MAX_RAYS: usize = 8;

/// A ray to be answered.
#[derive(Clone, Debug)]
pub(super) struct Question {
    /// Which pick asks.
    pub(super) id: u32,
    pub(super) ray: Ray,
    /// As the viewer sees it.
    pub(super) camera: Camera,
    pub(super) viewport: Viewport,
    pub(super) two_sided: bool,
    pub(super) planes: Vec<[f64; 4]>,
}

/// An answer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Answer {
    pub(super) id: u32,
    pub(super) hit: Option<Hit>,
    /// Whether everything along the ray was refined.
    pub(super) is_complete: bool,
}

/// See the module.
#[derive(Debug)]
pub(super) struct Probe {
    session: ClientSession,
    questions: VecDeque<Question>,
    /// When the first question was put to the server.
    asked_at: Option<Timestamp>,
    used_at: Timestamp,
}

impl Probe {
    pub(super) fn new(now: Timestamp, smallest_limit: u32) -> Self {
        let config = ClientConfig {
            triangle_limit: limit(smallest_limit),
            cache_entries: Some(1024),
            ..ClientConfig::default()
        };
        Self { session: ClientSession::new(config), questions: VecDeque::new(), asked_at: None, used_at: now }
    }

    /// Puts a question at the end of the queue. `false` if too many wait.
    pub(super) fn ask(&mut self, now: Timestamp, question: Question) -> bool {
        self.used_at = now;
        if self.questions.len() < MAX_RAYS {
            self.questions.push_back(question);
            return true;
        }
        false
    }

    pub(super) fn session_mut(&mut self) -> &mut ClientSession {
        &mut self.session
    }

    /// Whether the connection has served.
    pub(super) fn is_over(&self, now: Timestamp) -> bool {
        self.questions.is_empty() && now.since(self.used_at) > KEPT
            || self.asked_at.is_some_and(|at| now.since(at) > PATIENCE)
    }

    /// When [`is_over`](Self::is_over) changes by itself.
    pub(super) fn poll_timeout(&self) -> Timestamp {
        self.asked_at.map_or(self.used_at + KEPT, |at| at + PATIENCE) + Duration::from_millis(1)
    }

    /// Questions without an answer, when the connection ends.
    pub(super) fn unanswered(&self) -> impl Iterator<Item = u32> + '_ {
        self.questions.iter().map(|question| question.id)
    }

    /// Asks for what the first question needs, and answers it when that is there.
    ///
    /// # Errors
    /// Those of the session.
    pub(super) fn tick(&mut self, now: Timestamp) -> Result<Option<Answer>, ClientError> {
        let Some(question) = self.questions.front() else { return Ok(None) };
        let Some(model) = self.session.model() else {
            self.asked_at.get_or_insert(now);
            return Ok(None);
        };
        let (view, lattice) = (view_along(question, limit(model.smallest_limit)), model.lattice);
        let seq = match self.session.set_view(now, view) {
            Ok(seq) => seq,
            // The viewer's own view had the same fault and was never sent; nothing can be along such a ray.
            Err(_) => {
                let id = question.id;
                self.questions.pop_front();
                return Ok(Some(Answer { id, hit: None, is_complete: false }));
            }
        };
        self.asked_at.get_or_insert(now);
        let Some(settled) = self.session.settled().filter(|settled| settled.view == seq) else { return Ok(None) };
        let replica = self.session.replica().expect("a settled session has a mesh");
        let hit = first_hit(replica, &lattice, &question.ray, question.camera.near, &question.planes);
        let answer = Answer { id: question.id, hit, is_complete: !settled.outcome.limited };
        self.questions.pop_front();
        self.asked_at = None;
        self.used_at = now;
        Ok(Some(answer))
    }
}

fn limit(smallest_limit: u32) -> u32 {
    TRIANGLES.max(smallest_limit.saturating_mul(2))
}

/// All that the eye sees within [`SPAN_PX`] around the ray, in full detail.
fn view_along(question: &Question, triangle_limit: u32) -> View {
    let mut camera = question.camera;
    let units = question.viewport.height_px.max(1) as f64;
    match &mut camera.projection {
        Projection::Perspective { fov_y_rad } => {
            // Off the axis a pixel spans a smaller angle, so this is enough for any.
            *fov_y_rad = (2.0 * (f64::from(*fov_y_rad) / 2.0).tan() * SPAN_PX / units).max(2e-6) as f32;
            let near = camera.near;
            camera.look_at(camera.eye, camera.eye + question.ray.direction);
            camera.near = near;
        }
        Projection::Orthographic { height } => {
            *height *= SPAN_PX / units;
            camera.eye = question.ray.origin;
        }
    }
    let detail = Detail { triangle_limit, tolerance_px: 0.0, complete: false, two_sided: question.two_sided };
    let mut view = camera.view(Viewport { width_px: HEIGHT_PX, height_px: HEIGHT_PX }, &detail);
    view.clip_planes.clone_from(&question.planes);
    view
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn the_pyramid_holds_the_ray_and_little_else() {
        let viewport = Viewport { width_px: 1200, height_px: 800 };
        for projection in [Projection::Perspective { fov_y_rad: 0.8 }, Projection::Orthographic { height: 3.0 }] {
            let mut camera = Camera { projection, ..Camera::perspective(0.8) };
            camera.look_at(DVec3::new(3.0, 2.0, 5.0), DVec3::ZERO);
            for pixel in [[600.0, 400.0], [3.0, 790.0], [1100.0, 20.0]] {
                let ray = camera.ray(viewport, pixel);
                let question = Question { id: 1, ray, camera, viewport, two_sided: false, planes: Vec::new() };
                let view = view_along(&question, 1000);
                assert_eq!(view.validate(), Ok(()));
                let sees = |p: DVec3| view.planes().iter().all(|plane| plane.normal.dot(p) + plane.offset >= 0.0);
                let beside = |dx: f64, dy: f64| camera.ray(viewport, [pixel[0] + dx, pixel[1] + dy]).at(4.0);
                assert!(sees(ray.at(1.0)) && sees(ray.at(50.0)), "{pixel:?}");
                assert!(!sees(beside(4.0, 0.0)) && !sees(beside(0.0, -4.0)), "{pixel:?}");
            }
        }
    }
}
