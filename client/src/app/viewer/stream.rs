//! The stream: frames between connections and sessions, how much of what came is applied for an image, and the state.

use lodestream_protocol::time::Timestamp;

use super::command::Event;
use super::line::{Ending, Trouble};
use super::state::{self, State};
use super::{FOV_RAD, Request, Viewer, Wire, permalink, with_causes};
use crate::camera::Viewport;
use crate::core::{ClientError, ClientSession, Connectivity};
use crate::render::upload::planned_bytes;

impl Viewer {
    /// Takes a connection that was opened, and on which this hello was sent, before the viewer was there. `false` if the
    /// viewer would have said something else: that connection is of no use then.
    pub fn adopt(&mut self, now: Timestamp, hello: &[u8]) -> bool {
        let mut session = ClientSession::new(self.session_config());
        if session.poll_transmit(now).as_deref() != Some(hello) || !self.line.poll_open(now, &mut self.session) {
            return false;
        }
        self.session = session;
        self.sent_bytes = hello.len() as u64;
        self.line.handle_open();
        true
    }

    /// A connection is open.
    pub fn handle_open(&mut self, wire: Wire) {
        match (wire, &mut self.probe) {
            (Wire::Main, _) => self.line.handle_open(),
            (Wire::Probe, Some((_, is_open))) => *is_open = true,
            (Wire::Probe, None) => self.requests.push_back(Request::Close(Wire::Probe)),
        }
    }

    /// A connection brought a frame.
    pub fn handle_frame(&mut self, now: Timestamp, wire: Wire, frame: &[u8]) {
        // The head of a frame of WebSocket, as servers send it.
        let bytes = frame.len() as u64 + if frame.len() < 126 { 2 } else { 4 };
        self.received.add(now, bytes as f64);
        self.figures.bytes_received += bytes;
        match wire {
            Wire::Main => {
                self.received_bytes += bytes;
                self.session.note_traffic(self.received_bytes, self.sent_bytes);
                match self.session.handle_frame(now, frame) {
                    Ok(()) => self.line.note_frame(),
                    Err(error) => self.note_fault(now, &error),
                }
            }
            Wire::Probe => {
                if let Some((probe, _)) = &mut self.probe
                    && probe.session_mut().handle_frame(now, frame).is_err()
                {
                    self.end_probe();
                }
            }
        }
    }

    /// A connection ended, or could not be opened.
    pub fn handle_end(&mut self, now: Timestamp, wire: Wire, ending: &Ending) {
        match wire {
            Wire::Main => {
                self.line.handle_end(now, ending, &mut self.session);
                self.progress.begin();
            }
            Wire::Probe => self.end_probe(),
        }
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self, now: Timestamp) -> Option<(Wire, Vec<u8>)> {
        if self.line.is_open()
            && let Some(frame) = self.session.poll_transmit(now)
        {
            self.sent_bytes += frame.len() as u64;
            return Some((Wire::Main, frame));
        }
        let (probe, is_open) = self.probe.as_mut()?;
        let frame = is_open.then(|| probe.session_mut().poll_transmit(now))??;
        Some((Wire::Probe, frame))
    }

    /// Applies batches until their uploads fill the allowance. A batch is applied whole, as it is decoded in one piece and only its end
    /// says whether both ends agree: one that is larger than the allowance has an image to itself. Servers keep theirs to 2,048 splits, 768 where
    /// a triangle limit binds; a decoder takes none of more than
    /// [`MAX_OPS_PER_BATCH`](lodestream_protocol::limits::MAX_OPS_PER_BATCH) ops. The mesh that is not on screen has no uploads, and its batches are
    /// applied in the same amounts.
    pub(super) fn apply(&mut self, now: Timestamp) {
        let mut unseen = 0;
        while let Some(op_bytes) = self.session.next_op_bytes() {
            // A mesh that was never drawn is uploaded whole, whatever is applied before.
            let seen = self.planned_bytes();
            let planned = seen.unwrap_or(unseen);
            if !self.allowance.admits(planned, op_bytes) {
                break;
            }
            match self.session.apply_ready(now, 1) {
                Ok(ops) => self.ops_since_image = self.ops_since_image.saturating_add(ops),
                Err(error) => return self.note_fault(now, &error),
            }
            match self.planned_bytes().filter(|_| seen.is_some()) {
                Some(after) if op_bytes > 0 => self.allowance.learn(planned, after, op_bytes),
                _ => unseen += self.allowance.estimate(op_bytes),
            }
        }
    }

    /// What is to be uploaded for the mesh on screen, if that is the one that batches are applied to.
    pub(super) fn planned_bytes(&mut self) -> Option<u64> {
        if self.session.is_restarting() {
            return None;
        }
        planned_bytes(self.session.replica_mut()?)
    }

    fn note_fault(&mut self, now: Timestamp, error: &ClientError) {
        self.requests.push_back(Request::Close(Wire::Main));
        self.line.note_fault(now, &with_causes(error), &mut self.session);
    }

    pub(super) fn is_dirty(&mut self) -> bool {
        let generation = self.session.generation();
        let Some(replica) = self.session.replica_mut() else { return false };
        self.drawn_generation != Some(generation) || replica.dirty_mut().is_none_or(|dirty| !dirty.is_empty())
    }

    pub(super) fn update_state(&mut self) {
        let is_lost = matches!(self.session.connectivity(), Connectivity::Reconnecting { .. });
        self.state = match self.line.trouble() {
            Some(Trouble::Failed { reason }) => State::Failed { reason: reason.clone() },
            Some(Trouble::Gone) => State::Gone,
            Some(Trouble::Full) => State::Full,
            // A first attempt that failed is told as what it is.
            None if self.session.model().is_none() => State::Connecting,
            None if is_lost => State::Reconnecting,
            None => match self.session.settled() {
                Some(settled) if !self.session.has_ready() => {
                    self.progress.settle(self.session.stats().triangles);
                    State::Settled { limited: settled.outcome.limited }
                }
                _ => {
                    let Viewport { width_px, height_px } = self.options.viewport;
                    let guess = state::guess(u64::from(width_px) * u64::from(height_px), self.tolerance_px());
                    let whole = self.session.model().map_or(u64::MAX, |model| model.triangles);
                    let most = self.triangle_limit().min(u32::try_from(whole).unwrap_or(u32::MAX));
                    State::Refining { percent: self.progress.note(self.session.stats().triangles, guess, most) }
                }
            },
        };
    }

    pub(super) fn wake(&self, now: Timestamp, image_due: Option<Timestamp>) -> Option<Timestamp> {
        if self.is_moving() || self.session.has_ready() || !self.requests.is_empty() {
            return Some(now);
        }
        let image = self.needs_image.then(|| image_due.unwrap_or(now)).filter(|_| self.replica().is_some());
        let probe = self.probe.as_ref().map(|(probe, _)| probe.poll_timeout());
        let view = self.session.poll_timeout().filter(|_| self.line.is_open());
        [image, view, self.line.poll_timeout(&self.session), probe].into_iter().flatten().min()
    }

    pub(super) fn set(&mut self, now: Timestamp, key: &str, value: &str) {
        let rate = self.settings.byte_rate;
        if let Err(error) = self.settings.set(key, value) {
            return self.notify(Event::Notice(error.to_string()));
        }
        if self.settings.byte_rate != rate {
            self.reconnect(now);
        }
    }

    pub(super) fn open_link(&mut self, now: Timestamp, link: &str) {
        let (pose, settings) = permalink::read(link, FOV_RAD);
        let rate = std::mem::replace(&mut self.settings, settings).byte_rate;
        if rate != settings.byte_rate {
            self.reconnect(now);
        }
        match (&mut self.navigator, pose) {
            (Some(navigator), Some(pose)) => navigator.set_pose(pose.orbit, pose.fov_rad, pose.is_orthographic),
            (None, pose) => self.linked = pose,
            (Some(_), None) => {}
        }
    }

    /// The byte rate is part of the hello.
    fn reconnect(&mut self, now: Timestamp) {
        self.requests.push_back(Request::Close(Wire::Main));
        self.line.restart(now, self.session_config(), &mut self.session);
    }
}
