//! What frames do to the mesh: the base, batches, the word that a view is settled, restarts, and disagreements between the ends.
//!
//! It knows nothing of connections; they only say whose mesh is shown when a session had to begin anew.

use lodestream_protocol::ids::{BatchSeq, ViewSeq};
use lodestream_protocol::limits::{MAX_CACHE_ENTRIES, MAX_TEXT_BYTES};
use lodestream_protocol::message::{Batch, ModelInfo, Settled};
use lodestream_protocol::op::{OpState, decode_base, decode_batch};
use lodestream_protocol::time::Timestamp;

use super::inbox::Inbox;
use super::{ClientError, ClientSession, Connectivity, Model, stats};

/// Resets after which the session gives up, unless enough batches went well in between.
pub(super) const MAX_RESETS: u32 = 4;
/// Batches in a row that must go well before earlier resets are forgiven.
const FORGIVING_BATCHES: u32 = 64;

impl ClientSession {
    pub(super) fn begin(
        &mut self,
        now: Timestamp,
        info: ModelInfo,
        cache_entries: u32,
        base: &[u8],
    ) -> Result<(), ClientError> {
        check_model(&info)?;
        if cache_entries > MAX_CACHE_ENTRIES {
            return Err(ClientError::BadModel("cache size"));
        }
        let base = decode_base(base, info.lattice.bits, info.has_colors)?;
        let state = OpState::new(&base, info.lattice.bits, info.has_colors, info.has_moves, cache_entries)?
            .with_step(info.visual_step);
        let model = Model { info, base, cache_entries, state };
        let before = self.model.replace(model);
        self.inbox = Inbox::default();
        self.applied = BatchSeq(0);
        (self.limit, self.lambda_px) = (None, None);
        self.awaits_restart = false;
        (self.ack_due, self.reset_due) = (None, None);
        self.batches_since_reset = 0;
        self.applied_view = None;
        match before {
            None => {
                self.generation = self.generation.wrapping_add(1);
                self.answered(now, Connectivity::Connected);
            }
            Some(before) => {
                self.stats.restarted += 1;
                // One that was kept already is the better one.
                self.kept.get_or_insert(before);
                self.answered(now, Connectivity::Restarting);
                self.unsettle();
            }
        }
        self.note_mesh(now);
        Ok(())
    }

    pub(super) fn answered(&mut self, now: Timestamp, connectivity: Connectivity) {
        self.answered_at = Some(now);
        self.connectivity = connectivity;
    }

    /// Shows the new mesh if it is as good as the one from before, as far as can be told here: what the view asks for, or as many
    /// triangles. A mesh of another model goes at once.
    fn compare(&mut self) {
        let (Some(kept), Some(model)) = (&self.kept, &self.model) else { return };
        let is_same = kept.info.hash == model.info.hash && kept.info.lattice == model.info.lattice;
        let is_as_large = model.state.replica().triangle_count() >= kept.state.replica().triangle_count();
        if is_same && self.settled.is_none() && !is_as_large {
            return;
        }
        let is_tracked = self.kept.take().is_some_and(|mut kept| kept.state.replica_mut().dirty_mut().is_some());
        if let Some(model) = self.model.as_mut().filter(|_| is_tracked) {
            model.state.replica_mut().track_dirty();
        }
        self.generation = self.generation.wrapping_add(1);
        if self.connectivity == Connectivity::Restarting {
            self.connectivity = Connectivity::Connected;
        }
    }

    pub(super) fn restart(&mut self, now: Timestamp) -> Result<(), ClientError> {
        let Model { info, base, cache_entries, state } = self.model.as_mut().expect("the inbox opens with the welcome");
        let is_tracked = state.replica_mut().dirty_mut().is_some();
        *state = OpState::new(base, info.lattice.bits, info.has_colors, info.has_moves, *cache_entries)?
            .with_step(info.visual_step);
        if is_tracked {
            state.replica_mut().track_dirty();
        }
        if self.kept.is_none() {
            self.generation = self.generation.wrapping_add(1);
        }
        self.awaits_restart = false;
        self.applied = BatchSeq(0);
        (self.limit, self.lambda_px) = (None, None);
        self.batches_since_reset = 0;
        // Batches before the restart are of no interest any more, and their numbers come again.
        self.ack_due = None;
        self.unsettle();
        self.note_mesh(now);
        Ok(())
    }

    pub(super) fn apply(&mut self, now: Timestamp, batch: &Batch) -> Result<u32, ClientError> {
        let next = BatchSeq(self.applied.0.wrapping_add(1));
        self.limit = batch.limit.or(self.limit);
        self.lambda_px = batch.lambda_px.or(self.lambda_px);
        let state = &mut self.model.as_mut().expect("the inbox opens with the welcome").state;
        let Some(limit) = self.limit.filter(|_| batch.seq == next.low()) else { return self.disagree(next) };
        let result = decode_batch(&batch.ops, state, limit);
        let digest = state.replica().digest() as u16;
        let counts = match result {
            Ok(counts) if digest == batch.digest => counts,
            _ => {
                self.note_mesh(now);
                return self.disagree(next);
            }
        };
        self.applied = next;
        let view = self.current.as_ref().map_or(ViewSeq(0), |current| current.seq.newest(batch.view));
        self.applied_view = Some(view);
        self.ack_due = Some(next);
        self.batches_since_reset = self.batches_since_reset.saturating_add(1);
        if self.batches_since_reset >= FORGIVING_BATCHES {
            self.resets_in_a_row = 0;
        }
        self.stats.count(batch.ops.len(), &counts);
        // Ops after a settled state are on the way to another one, whichever view they were chosen for.
        self.unsettle();
        self.stats.error_px = self.lambda_px;
        if let Some(current) = &self.current
            && current.seq == view
            && self.stats.view_latency_ms.is_none()
        {
            self.stats.view_latency_ms = Some(now.since(current.set_at).as_secs_f64() * 1e3);
        }
        self.note_mesh(now);
        if let Some(outcome) = batch.outcome {
            self.settle(now, Settled { view, seq: next, outcome })?;
        }
        Ok(counts.total())
    }

    pub(super) fn settle(&mut self, now: Timestamp, settled: Settled) -> Result<(), ClientError> {
        if settled.seq != self.applied {
            self.disagree(settled.seq)?;
            return Ok(());
        }
        if self.current.as_ref().is_none_or(|current| current.seq != settled.view) {
            return Ok(());
        }
        self.settled = Some(settled);
        self.stats.settled = true;
        self.stats.limited = settled.outcome.limited;
        self.stats.error_px = Some(settled.outcome.error_px);
        self.stats.settled_ms = Some(stats::millis(now));
        self.note_mesh(now);
        Ok(())
    }

    /// The two ends hold different meshes: everything until the server's restart is of no use.
    fn disagree(&mut self, seq: BatchSeq) -> Result<u32, ClientError> {
        self.stats.resets += 1;
        self.resets_in_a_row += 1;
        if self.resets_in_a_row > MAX_RESETS {
            return Err(ClientError::Disagreement { resets: self.stats.resets });
        }
        self.awaits_restart = true;
        self.reset_due = Some(seq);
        self.unsettle();
        Ok(0)
    }

    pub(super) fn unsettle(&mut self) {
        self.settled = None;
        self.stats.settled = false;
        self.stats.limited = false;
        self.stats.settled_ms = None;
    }

    fn note_mesh(&mut self, now: Timestamp) {
        self.compare();
        let Some(model) = &self.model else { return };
        let replica = model.state.replica();
        self.stats.note_mesh(now, replica.vertex_count(), replica.triangle_count());
    }
}

/// Checks every number that the client computes with.
fn check_model(info: &ModelInfo) -> Result<(), ClientError> {
    let check = |ok: bool, field| if ok { Ok(()) } else { Err(ClientError::BadModel(field)) };
    check(info.lattice.is_valid(), "lattice")?;
    let max = info.lattice.max_coordinate();
    let fits = |k: usize| 0 <= info.box_min[k] && info.box_min[k] <= info.box_max[k] && info.box_max[k] <= max;
    check((0..3).all(fits), "box")?;
    check(info.title.len() <= MAX_TEXT_BYTES, "title")?;
    check(info.crease_angle_deg.is_finite(), "crease angle")
}
