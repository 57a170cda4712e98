//! Geomorphs as plain data: where each vertex comes from, since when, how fast.
//!
//! A vertex that a split makes starts where its parent is *shown* at that moment and moves to its own place; one that an op
//! moves starts where it is shown itself. Since every start is a shown position, transitions may overlap in any way and
//! nothing jumps (Azuma 2000, section 3.5; Hoppe 1998). What cannot be seen moving is in its place at once: what is out of
//! the image, or moves by less than a fraction of a pixel. Nothing here knows the GPU: `morph_buffers` has the states there.

use std::ops::Range;
use std::time::Duration;

use bytemuck::{Pod, Zeroable};
use glam::{Vec3, Vec4};
use lodestream_protocol::mesh::{Birth, Replica};

use super::camera::CameraUniform;

/// How long a transition takes while the camera rests.
pub const LONGEST: Duration = Duration::from_millis(400);
/// How long it takes at least: the faster the camera moves, the sooner the mesh has to be what the view needs.
pub const SHORTEST: Duration = Duration::from_millis(80);
/// Speed of the camera at which transitions take half of [`LONGEST`], in image heights per second.
const HALVING_SPEED: f32 = 0.25;
/// Ways shorter than this are not seen.
const LEAST_WAY_PX: f32 = 0.3;
/// Triangles smaller than this, in square pixels, are not seen to go.
const LEAST_AREA_PX: f32 = 0.3;

/// The state of a slot as the shader has it.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct GpuMorph {
    /// Lattice coordinates at the beginning.
    pub from: [f32; 3],
    /// The beginning, in seconds of [`Morphs::now_s`].
    pub begin_s: f32,
    /// Inverse duration; 0 for a vertex in its place.
    pub rate_per_s: f32,
}

#[derive(Clone, Copy, Debug, Default)]
struct Slot {
    state: GpuMorph,
    target: [f32; 3],
}

/// All transitions of one replica.
#[derive(Debug, Default)]
pub struct Morphs {
    slots: Vec<Slot>,
    /// When `now_s` was 0.
    epoch: Duration,
    now_s: f32,
    /// When the last of the running transitions ends.
    end_s: f32,
    /// Time of the last image, if something was on its way then and is still.
    moved_since_s: Option<f32>,
    /// Slots whose transitions may still run.
    running: Vec<u32>,
    /// Slots whose state differs from what was last taken.
    changed: Vec<u32>,
}

/// Where a vertex of this state is shown. The dull twin of `morph.wgsl`.
pub fn shown(state: &GpuMorph, target: [f32; 3], now_s: f32) -> [f32; 3] {
    let t = (now_s - state.begin_s) * state.rate_per_s;
    if state.rate_per_s <= 0.0 || t >= 1.0 {
        return target;
    }
    let t = t.max(0.0);
    let eased = t * t * (3.0 - 2.0 * t);
    std::array::from_fn(|k| state.from[k] * (1.0 - eased) + target[k] * eased)
}

/// What [`Morphs::advance`] needs to know about the image.
#[derive(Clone, Copy, Debug)]
pub struct MorphView<'a> {
    /// The camera.
    pub camera: &'a CameraUniform,
    /// Size of the image in pixels.
    pub size: [u32; 2],
    /// Longest side of the lattice's box, in steps.
    pub extent: f32,
    /// How long transitions take that begin now.
    pub duration: Duration,
}

impl MorphView<'_> {
    /// Inverse duration of transitions that begin now.
    pub(super) fn rate_per_s(&self) -> f32 {
        1.0 / self.duration.max(Duration::from_millis(1)).as_secs_f32()
    }

    /// Whether a triangle covers anything worth fading.
    pub(super) fn shows(&self, places: [Vec3; 3]) -> bool {
        let corners = places.map(|place| self.camera.clip(place));
        if corners.iter().any(|c| c.w <= 0.0 || c.z > c.w) {
            return false;
        }
        let [width, height] = self.size.map(|side| side as f32);
        let [a, b, c] = corners.map(|c| Vec3::new(c.x / c.w * width, c.y / c.w * height, 0.0) / 2.0);
        let is_inside = [a, b, c].iter().any(|p| p.x.abs() <= 0.55 * width && p.y.abs() <= 0.55 * height);
        is_inside && (b - a).cross(c - a).length() / 2.0 >= LEAST_AREA_PX
    }

    /// Whether a vertex on its way from one place to the other is seen moving.
    fn sees(&self, from: [f32; 3], to: [f32; 3]) -> bool {
        let [a, b] = [from, to].map(|p| self.camera.clip(Vec3::from_array(p)));
        let is_inside = |c: Vec4| c.w > 0.0 && c.x.abs() <= 1.1 * c.w && c.y.abs() <= 1.1 * c.w && c.z <= c.w;
        if !is_inside(a) && !is_inside(b) {
            return false;
        }
        let (a, b) = (a.truncate() / a.w.max(1e-20), b.truncate() / b.w.max(1e-20));
        let [width, height] = self.size.map(|side| side as f32);
        let way = (a - b) * Vec3::new(0.5 * width, 0.5 * height, 0.0);
        way.length_squared() >= LEAST_WAY_PX * LEAST_WAY_PX
    }
}

impl Morphs {
    /// Takes the births since the last call and the vertices that were touched, and lets transitions begin at `now`, which
    /// never goes back. Without `births` (`None`: not all are known) every vertex is in its place at once.
    pub fn advance(
        &mut self,
        now: Duration,
        births: Option<&[Birth]>,
        touched: &[Range<u32>],
        replica: &Replica,
        view: &MorphView<'_>,
    ) {
        self.tick(now);
        self.begin(births, touched, replica, view);
    }

    /// The first half of [`advance`](Self::advance): time goes on to `now`, and what is known is still that of the last image.
    pub fn tick(&mut self, now: Duration) {
        let before_s = self.now_s;
        self.now_s = now.saturating_sub(self.epoch).as_secs_f32();
        self.moved_since_s = self.is_running().then_some(before_s);
        if !self.is_running() {
            self.rest(now);
        }
    }

    /// The second half: transitions begin.
    pub fn begin(&mut self, births: Option<&[Birth]>, touched: &[Range<u32>], replica: &Replica, view: &MorphView<'_>) {
        self.slots.resize_with(replica.slot_end() as usize, Slot::default);
        let place = |slot: u32| replica.positions()[slot as usize].map(|x| x as f32);
        let Some(births) = births else {
            self.forget();
            for slot in replica.vertices().iter() {
                self.slots[slot as usize].target = place(slot);
            }
            return;
        };
        for birth in births {
            let start = match birth.parent {
                Some(parent) => self.shown(parent),
                None => place(birth.slot),
            };
            // A slot that is taken anew forgets what was there.
            self.put(birth.slot, Slot { state: GpuMorph::default(), target: start });
        }
        let rate_per_s = view.rate_per_s();
        for slot in touched.iter().cloned().flatten().filter(|&slot| replica.vertices().contains(slot)) {
            let target = place(slot);
            if self.slots[slot as usize].target == target {
                continue;
            }
            let from = self.shown(slot);
            let mut state = GpuMorph::default();
            if view.sees(from, target) {
                state = GpuMorph { from, begin_s: self.now_s, rate_per_s };
                self.end_s = self.end_s.max(self.now_s + 1.0 / rate_per_s);
                self.running.push(slot);
            }
            self.put(slot, Slot { state, target });
        }
    }

    /// Seconds that the states count from.
    pub fn now_s(&self) -> f32 {
        self.now_s
    }

    /// How much of the rest of its way something goes from the last image to this one that is to arrive with the last vertex.
    pub fn share(&self) -> f32 {
        let Some(before_s) = self.moved_since_s else { return 0.0 };
        let (elapsed_s, left_s) = (self.now_s - before_s, self.end_s - before_s);
        if left_s > 0.0 { (elapsed_s / left_s).clamp(0.0, 1.0) } else { 1.0 }
    }

    /// Something else than a vertex is on its way until then.
    pub fn hold(&mut self, end_s: f32) {
        self.end_s = self.end_s.max(end_s);
    }

    /// Whether a vertex is on its way.
    pub fn is_running(&self) -> bool {
        self.now_s < self.end_s
    }

    /// Where a vertex is shown now, in lattice coordinates.
    pub fn shown(&self, slot: u32) -> [f32; 3] {
        let Slot { state, target } = &self.slots[slot as usize];
        shown(state, *target, self.now_s)
    }

    /// Slots whose states changed since this was last called, ascending, without repeats.
    pub fn take_changed(&mut self) -> Vec<u32> {
        let mut changed = std::mem::take(&mut self.changed);
        changed.sort_unstable();
        changed.dedup();
        changed
    }

    /// Slots whose vertices are not in their places, ascending.
    pub fn on_their_way(&self) -> Vec<u32> {
        (0..self.len()).filter(|&slot| self.state(slot) != GpuMorph::default()).collect()
    }

    /// The state of a slot.
    pub fn state(&self, slot: u32) -> GpuMorph {
        self.slots[slot as usize].state
    }

    /// Slots that states are kept for.
    pub fn len(&self) -> u32 {
        self.slots.len() as u32
    }

    /// Whether states are kept for no slot.
    pub fn is_empty(&self) -> bool {
        self.slots.is_empty()
    }

    fn put(&mut self, slot: u32, value: Slot) {
        let held = &mut self.slots[slot as usize];
        if held.state != value.state {
            self.changed.push(slot);
        }
        *held = value;
    }

    /// Nothing moves: time starts again, so that its floats stay fine.
    fn rest(&mut self, now: Duration) {
        self.forget();
        (self.epoch, self.now_s, self.end_s) = (now, 0.0, 0.0);
    }

    fn forget(&mut self) {
        for slot in std::mem::take(&mut self.running) {
            // Slots beyond the end belong to a replica that is gone.
            if let Some(held) = self.slots.get(slot as usize).copied() {
                self.put(slot, Slot { state: GpuMorph::default(), ..held });
            }
        }
        self.end_s = self.now_s;
    }
}

/// How fast the camera moves, and how long transitions may take therefore.
#[derive(Clone, Copy, Debug, Default)]
pub struct Motion {
    last: Option<(Duration, CameraUniform)>,
    /// In image heights per second, smoothed.
    speed: f32,
}

impl Motion {
    /// The camera is this at `now`; returns how long transitions take that begin now.
    pub fn follow(&mut self, now: Duration, camera: &CameraUniform, extent: f32) -> Duration {
        if let Some((before, last)) = &self.last {
            let elapsed = now.saturating_sub(*before).as_secs_f32();
            if elapsed > 0.0 {
                let speed = moved(last, camera, extent) / elapsed;
                // A tenth of a second's memory: single images jitter.
                self.speed += (speed - self.speed) * (elapsed / (elapsed + 0.1));
            }
        }
        if self.last.is_none_or(|(before, _)| now > before) {
            self.last = Some((now, *camera));
        }
        LONGEST.div_f32(1.0 + self.speed.min(1e3) / HALVING_SPEED).clamp(SHORTEST, LONGEST)
    }
}

/// Mean way of the corners of the lattice's box in the image, in image heights; those behind the eye in one of both do not
/// count.
fn moved(before: &CameraUniform, after: &CameraUniform, extent: f32) -> f32 {
    let (mut sum, mut count) = (0.0, 0.0f32);
    for k in 0..8 {
        let corner = Vec3::from_array([k & 1, k >> 1 & 1, k >> 2].map(|bit| bit as f32 * extent));
        let [a, b] = [before, after].map(|camera| camera.clip(corner));
        if a.w > 0.0 && b.w > 0.0 {
            // Far outside of the image, directions matter no more than at its edge.
            let at = |c: Vec4| (c.truncate() / c.w).clamp(Vec3::splat(-4.0), Vec3::splat(4.0)).truncate();
            sum += 0.5 * at(a).distance(at(b));
            count += 1.0;
        }
    }
    if count > 0.0 { sum / count } else { 0.0 }
}
