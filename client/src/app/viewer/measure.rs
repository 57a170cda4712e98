//! Points on the surface and the distance between them: at once from the mesh on screen, then exactly from a [`Probe`].

use glam::DVec3;
use lodestream_protocol::time::Timestamp;

use super::command::Event;
use super::probe::{Probe, Question};
use super::{Request, Viewer, Wire, pick, render_camera};
use crate::camera::Bounds;
use crate::render::Line;
use crate::render::lines::frustum;

/// Colour of marks, in sRGB.
const MARK_COLOR: [u8; 3] = [0xff, 0xb0, 0x20];

/// A point on the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// In model units.
    pub point: DVec3,
    /// Whether it lies on the complete model, not just on what is on screen.
    pub is_exact: bool,
    id: u32,
}

impl Viewer {
    /// The marks, at most two.
    pub fn marks(&self) -> &[Mark] {
        &self.marks
    }

    /// The distance between the marks in model units, and whether both are exact.
    pub fn distance(&self) -> Option<(f64, bool)> {
        let [a, b] = self.marks[..] else { return None };
        Some((a.point.distance(b.point), a.is_exact && b.is_exact))
    }

    /// Where a point is in the image, if it is in front of the camera.
    pub fn pixel(&self, point: DVec3) -> Option<[f64; 2]> {
        self.navigator.as_ref()?.camera().pixel(self.options.viewport, point)
    }

    /// The line between the marks and the edges of a frozen view, to be drawn on top of the mesh.
    pub fn lines(&self) -> Vec<Line> {
        let mut lines = match self.marks[..] {
            [a, b] => vec![Line { from: a.point, to: b.point, color: MARK_COLOR }],
            _ => Vec::new(),
        };
        if let Some((camera, model)) = self.frozen.zip(self.model()) {
            let bounds = Bounds::of(model);
            let depth = (bounds.center - camera.eye).dot(camera.forward()) + bounds.radius;
            let depth = depth.max(0.1 * bounds.radius);
            lines.extend(frustum(&render_camera(&camera), self.options.viewport.aspect(), depth, MARK_COLOR));
        }
        lines
    }

    pub(super) fn surface_at(&self, at_px: [f64; 2]) -> Option<DVec3> {
        let camera = self.navigator.as_ref()?.camera();
        let (model, replica) = (self.model()?, self.replica()?);
        let ray = camera.ray(self.options.viewport, at_px);
        pick::first_hit(replica, &model.lattice, &ray, camera.near, &self.clip_planes()).map(|hit| hit.point)
    }

    pub(super) fn pick(&mut self, now: Timestamp, at_px: [f64; 2]) {
        let (Some(navigator), Some(point)) = (&self.navigator, self.surface_at(at_px)) else {
            return self.notify(Event::Notice("there is no surface there".into()));
        };
        let camera = navigator.camera();
        let ray = camera.ray(self.options.viewport, at_px);
        if self.marks.len() >= 2 {
            self.marks.clear();
        }
        self.next_mark = self.next_mark.wrapping_add(1);
        let id = self.next_mark;
        self.marks.push(Mark { point, is_exact: false, id });
        self.notify(Event::Marked);
        let Some(model) = self.model() else { return };
        let (two_sided, smallest_limit) = (model.is_open, model.smallest_limit);
        let planes = self.clip_planes();
        let question = Question { id, ray, camera, viewport: self.options.viewport, two_sided, planes };
        if self.probe.is_none() {
            self.probe = Some((Probe::new(now, smallest_limit), false));
            self.requests.push_back(Request::Open(Wire::Probe));
        }
        if let Some((probe, _)) = &mut self.probe {
            // Where too many wait, the mark stays as it is.
            let _ = probe.ask(now, question);
        }
    }

    pub(super) fn tick_probe(&mut self, now: Timestamp) {
        let Some((probe, _)) = &mut self.probe else { return };
        match probe.tick(now) {
            Ok(Some(answer)) => {
                if let Some(mark) = self.marks.iter_mut().find(|mark| mark.id == answer.id)
                    && let Some(hit) = answer.hit
                {
                    mark.point = hit.point;
                    mark.is_exact = answer.is_complete;
                    self.notify(Event::Marked);
                    self.needs_image = true;
                }
            }
            Ok(None) if !probe.is_over(now) => {}
            Ok(None) | Err(_) => self.end_probe(),
        }
    }

    pub(super) fn end_probe(&mut self) {
        let Some((probe, _)) = self.probe.take() else { return };
        self.requests.push_back(Request::Close(Wire::Probe));
        if probe.unanswered().any(|id| self.marks.iter().any(|mark| mark.id == id)) {
            self.notify(Event::Notice(
                "the server did not refine this point: the mark is on the mesh on screen".into(),
            ));
        }
    }
}
