//! The op codec once more, plainly: a decoder written for reading, with sorted lists, stacks of entries and contexts in a map by
//! name, many times slower than the real one. It shares with it only the trained numbers and the replica.
//!
//! What it reads, a plain encoder writes again bit by bit, so that both directions are compared: a stream decodes to the
//! same ops, and encoding them gives the same bytes. It expects streams of an honest encoder and panics where others would
//! overflow.

mod coder;
mod patch;
mod ring;

use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroU16;

use lodestream_protocol::ids::VertexSlot;
use lodestream_protocol::mesh::{Cut, Fan, NewVertex, Patch, Replica, SplitUndo};
use lodestream_protocol::op::{BatchTrace, TRAINED};

use coder::{Contexts, Tape, contexts, names};
use ring::{Ring, lg};

/// What a decoder of ops holds.
pub struct Reference {
    replica: Replica,
    lattice_bits: u8,
    has_colors: bool,
    has_moves: bool,
    /// Of `visual` precision; 0 for `exact`.
    step: i32,
    contexts: Contexts,
    patch_contexts: Contexts,
    cache: Cache,
}

/// A cached split with those of the vertex that it made.
struct Cached {
    undo: SplitUndo,
    is_cut_known: bool,
    pushed: u64,
    nested: Vec<Cached>,
}

/// Each vertex's stack, the top last.
#[derive(Default)]
struct Cache {
    capacity: u32,
    pushes: u64,
    stacks: BTreeMap<u32, Vec<Cached>>,
}

impl Cache {
    fn top(&self, slot: u32) -> Option<&Cached> {
        self.stacks.get(&slot)?.last()
    }

    fn push(&mut self, t: u32, undo: SplitUndo) {
        let nested = self.stacks.remove(&t).unwrap_or_default();
        if self.capacity == 0 {
            return;
        }
        self.pushes += 1;
        let entry = Cached { undo, is_cut_known: true, pushed: self.pushes, nested };
        self.stacks.entry(undo.s.0).or_default().push(entry);
        while self.stacks.values().map(|stack| count(stack)).sum::<u32>() > self.capacity {
            let oldest = self.stacks.values().map(|stack| oldest(stack)).min().expect("it is not empty");
            self.stacks.values_mut().for_each(|stack| drop_entry(stack, oldest));
        }
    }
}

fn count(stack: &[Cached]) -> u32 {
    stack.iter().map(|entry| 1 + count(&entry.nested)).sum()
}

fn oldest(stack: &[Cached]) -> u64 {
    stack.iter().map(|entry| entry.pushed.min(oldest(&entry.nested))).min().unwrap_or(u64::MAX)
}

fn drop_entry(stack: &mut Vec<Cached>, pushed: u64) {
    stack.retain(|entry| entry.pushed != pushed);
    stack.iter_mut().for_each(|entry| drop_entry(&mut entry.nested, pushed));
}

fn forget_cuts(stack: &mut [Cached]) {
    for entry in stack {
        entry.is_cut_known = false;
        forget_cuts(&mut entry.nested);
    }
}

fn op_contexts() -> Contexts {
    let one = |name: &str| vec![name.to_owned()];
    let sets = |name: &str, end| -> Vec<String> {
        names::each(name, &[end]).iter().flat_map(|name| names::scaled_set(name)).collect()
    };
    let gaps = |name: &str| [sets(name, 4), names::number(&format!("{name}/escape"))].concat();
    let residuals = |name: &str| -> Vec<String> {
        let axes = ["across", "along", "height"].map(|axis| names::scaled_set(&format!("{name}/{axis}")));
        [axes.concat(), names::number(&format!("{name}/escape"))].concat()
    };
    let all = [
        one("forget"),
        names::each("count", &[3]).iter().flat_map(|name| names::number(name)).collect(),
        gaps("collapse_gap"),
        gaps("split_gap"),
        names::number("spawn_gap"),
        names::each("collapse_flag", &[2]),
        names::each("split_flag", &[16, 2, 2]),
        one("same_cut"),
        names::each("cut/open_case", &[2]),
        names::each("cut/is_it", &[3, 32]),
        names::each("cut/arc", &[10, 8, 12]),
        names::each("cut/long_arc", &[8, 16]),
        residuals("vertex"),
        sets("color", 3),
        names::scaled_set("color/moved"),
        names::number("color/escape"),
        one("move/stays"),
        one("move/in_middle"),
        one("move/parity"),
        residuals("move"),
        names::each("steps/is_coarse", &[2, 2]),
        names::each("steps/is_fans_axis", &[8]),
        names::each("steps/is_next_axis", &[8]),
        names::scaled_set("steps/across"),
        names::scaled_set("steps/along"),
        names::number("steps/escape"),
    ];
    contexts(&all.concat(), TRAINED.priors)
}

/// The base mesh, and the bytes that encoding it gives.
///
/// # Errors
/// Says what is wrong with the stream.
pub fn decode_base(bytes: &[u8], lattice_bits: u8, has_colors: bool) -> Result<(Patch, Vec<u8>), String> {
    let mut tape = Tape::new(bytes);
    let patch = patch::read(&mut tape, &mut patch::patch_contexts(), lattice_bits, has_colors)?;
    Ok((patch, tape.encoded_again()))
}

impl Reference {
    /// Before any op.
    ///
    /// # Panics
    /// If the base is no manifold.
    pub fn new(base: &Patch, lattice_bits: u8, has_colors: bool, has_moves: bool, cache_entries: u32) -> Self {
        Self {
            replica: Replica::new(base).expect("the base is a manifold"),
            lattice_bits,
            has_colors,
            has_moves,
            step: 0,
            contexts: op_contexts(),
            patch_contexts: patch::patch_contexts(),
            cache: Cache { capacity: cache_entries, ..Cache::default() },
        }
    }

    /// The same for a model of `visual` precision.
    pub fn with_step(self, step: Option<NonZeroU16>) -> Self {
        Self { step: step.map_or(0, |step| step.get().into()), ..self }
    }

    /// The mesh.
    pub fn replica(&self) -> &Replica {
        &self.replica
    }

    /// Applies a batch; gives its ops and the bytes that encoding them gives.
    ///
    /// # Errors
    /// Says what is wrong with the stream.
    pub fn decode_batch(&mut self, bytes: &[u8]) -> Result<(BatchTrace, Vec<u8>), String> {
        let mut tape = Tape::new(bytes);
        let mut trace = BatchTrace { forgets_cuts: tape.bit(&mut self.contexts, "forget"), ..BatchTrace::default() };
        if trace.forgets_cuts {
            self.cache.stacks.values_mut().for_each(|stack| forget_cuts(stack));
        }
        self.collapses(&mut tape, &mut trace)?;
        self.spawns(&mut tape, &mut trace)?;
        self.splits(&mut tape, &mut trace)?;
        Ok((trace, tape.encoded_again()))
    }

    /// Members of a list, as gaps.
    fn gaps(&mut self, tape: &mut Tape<'_>, count: &str, gaps: &str, candidates: &[u32]) -> Result<Vec<u32>, String> {
        let count = u64::from(tape.number(&mut self.contexts, count));
        let mut members = Vec::new();
        let mut left = candidates;
        // In 1/16.
        let mut recent = left.len() as u64 * 16 / count.max(1);
        for i in 0..count {
            let expected = left.len() as u64 * 16 / (count - i);
            let class = match () {
                () if 8 * recent < expected => 0,
                () if 2 * recent < expected => 1,
                () if recent < 2 * expected => 2,
                () => 3,
            };
            let size = lg(recent.max(1)) - 64;
            let (name, escape) = (format!("{gaps}/{class}"), format!("{gaps}/escape"));
            let gap = tape.scaled(&mut self.contexts, &name, &escape, size);
            recent = (3 * recent + 16 * u64::from(gap)) / 4;
            members.push(*left.get(gap as usize).ok_or("a gap beyond the end")?);
            left = &left[gap as usize + 1..];
        }
        Ok(members)
    }

    fn collapses(&mut self, tape: &mut Tape<'_>, trace: &mut BatchTrace) -> Result<(), String> {
        let mut candidates: Vec<u32> = self.replica.collapsible().iter().collect();
        for round in 1.. {
            let members: Vec<u32> = if round == 1 {
                self.gaps(tape, "count/0", "collapse_gap", &candidates)?
            } else {
                let flag = format!("collapse_flag/{}", u32::from(round > 2));
                candidates.retain(|_| tape.bit(&mut self.contexts, &flag));
                candidates.clone()
            };
            let before: BTreeSet<u32> = self.replica.collapsible().iter().collect();
            for &slot in &members {
                if self.replica.is_spawn(VertexSlot(slot)) {
                    let (_, slots) = self.replica.despawn(VertexSlot(slot)).map_err(|e| e.to_string())?;
                    self.cache.stacks.retain(|slot, _| !slots.contains(slot));
                } else {
                    let undo = self.replica.collapse(VertexSlot(slot), &mut Vec::new()).map_err(|e| e.to_string())?;
                    self.cache.push(slot, undo);
                }
            }
            candidates = self.replica.collapsible().iter().filter(|slot| !before.contains(slot)).collect();
            trace.collapses.push(members);
            if candidates.is_empty() {
                break;
            }
        }
        Ok(())
    }

    fn spawns(&mut self, tape: &mut Tape<'_>, trace: &mut BatchTrace) -> Result<(), String> {
        let mut next = 0;
        for _ in 0..tape.number(&mut self.contexts, "count/1") {
            let gap = tape.number(&mut self.contexts, "spawn_gap") as usize;
            let spawned = self.replica.spawned_ids();
            let id = (next..).filter(|id| !spawned.contains(id)).nth(gap).ok_or("there are not so many ids")?;
            let patch = patch::read(tape, &mut self.patch_contexts, self.lattice_bits, self.has_colors)?;
            self.replica.spawn(id, &patch).map_err(|e| e.to_string())?;
            trace.spawns.push((id, patch));
            next = id + 1;
        }
        Ok(())
    }

    fn splits(&mut self, tape: &mut Tape<'_>, trace: &mut BatchTrace) -> Result<(), String> {
        // Vertices by the roles that they had: 1 for s, 2 for t, 4 for l, 8 for r.
        let mut roles: BTreeMap<u32, u32> = BTreeMap::new();
        for round in 1.. {
            let members: Vec<u32> = if round == 1 {
                let vertices: Vec<u32> = self.replica.vertices().iter().collect();
                self.gaps(tape, "count/2", "split_gap", &vertices)?
            } else {
                let late = u32::from(round > 2);
                let is_member = |&(&slot, roles): &(&u32, &u32)| {
                    let is_cached = u32::from(self.cache.top(slot).is_some());
                    tape.bit(&mut self.contexts, &format!("split_flag/{roles}/{is_cached}/{late}"))
                };
                roles.iter().filter(is_member).map(|(&slot, _)| slot).collect()
            };
            let mut splits = Vec::new();
            roles.clear();
            for &s in &members {
                let mut fan = Fan::default();
                self.replica.fan(VertexSlot(s), &mut fan).map_err(|e| e.to_string())?;
                let (cut, vertex) = self.split(tape, s, &fan);
                let t = self.replica.split(VertexSlot(s), &fan, cut, &vertex).map_err(|e| e.to_string())?.0;
                if let Some(entry) = self.cache.stacks.get_mut(&s).and_then(Vec::pop) {
                    self.cache.stacks.insert(t, entry.nested);
                }
                splits.push((s, cut, vertex));
                *roles.entry(s).or_default() |= 1;
                *roles.entry(t).or_default() |= 2;
                let mut role = |spoke: u32, role: u32| *roles.entry(fan.ring()[spoke as usize]).or_default() |= role;
                match cut {
                    Cut::Left { left } => role(left, 4),
                    Cut::Right { right } => role(right, 8),
                    Cut::Both { right, left } => {
                        role(left, 4);
                        role(right, 8);
                    }
                }
            }
            trace.splits.push(splits);
            if members.is_empty() {
                break;
            }
        }
        Ok(())
    }

    /// Where the fan of `s` opens, and the vertex that it gets.
    fn split(&mut self, tape: &mut Tape<'_>, s: u32, fan: &Fan) -> (Cut, NewVertex) {
        let ring = Ring::new(&self.replica, s, fan);
        let contexts = &mut self.contexts;
        if let Some(cached) = self.cache.stacks.get(&s).and_then(|stack| stack.last()) {
            let guess = if cached.is_cut_known { between(fan, &cached.undo) } else { None };
            let cut = match guess {
                Some(guess) if tape.bit(contexts, "same_cut") => guess,
                _ => ring.cut(tape, contexts),
            };
            return (cut, cached.undo.vertex);
        }
        let cut = ring.cut(tape, contexts);
        (cut, self.vertex(tape, &ring, s, cut))
    }

    fn vertex(&mut self, tape: &mut Tape<'_>, ring: &Ring, s: u32, cut: Cut) -> NewVertex {
        let contexts = &mut self.contexts;
        let coarse = if self.step > 0 { ring.coarse_axes(tape, contexts, self.step) } else { None };
        let (point, tangent, height) = ring.prediction(cut);
        let mut vertex = NewVertex::default();
        let axes = coarse.unwrap_or(ring.axes);
        for (axis, name) in [(axes[0], "across"), (axes[1], "along")] {
            vertex.position[axis] = match coarse {
                None => point[axis] + tape.scaled_signed(contexts, &format!("vertex/{name}"), "vertex/escape", tangent),
                Some(_) => {
                    let size = tangent - lg(self.step as u64);
                    let away = tape.scaled_signed(contexts, &format!("steps/{name}"), "steps/escape", size);
                    ((point[axis] + self.step / 2).div_euclid(self.step) + away) * self.step
                }
            };
        }
        let [u, v, h] = axes;
        let fall = ring.fall_along(axes, vertex.position[u] - point[u], vertex.position[v] - point[v]);
        let dh = tape.scaled_signed(contexts, "vertex/height", "vertex/escape", height);
        vertex.position[h] = point[h] - fall + dh;
        if self.has_colors {
            let colors = ring.beside(cut).map(|slot| self.replica.colors()[slot as usize]);
            vertex.color = color(tape, contexts, colors);
        }
        if self.has_moves {
            vertex.s_move = s_move(tape, contexts, ring, vertex.position, tangent, height);
            if self.has_colors {
                let before = self.replica.colors()[s as usize];
                let away = [0, 1, 2].map(|k| vertex.position[k] - ring.origin[k]);
                vertex.s_color_move = s_color_move(tape, contexts, before, vertex.color, vertex.s_move, away);
            }
        }
        vertex
    }
}

/// The cut that opens a fan between the vertices of an undone split, if it has both.
fn between(fan: &Fan, undo: &SplitUndo) -> Option<Cut> {
    let spoke = |slot: VertexSlot| (0..).zip(fan.ring()).find(|(_, at)| **at == slot.0).map(|(spoke, _)| spoke);
    let cut = match (undo.right == VertexSlot::NONE, undo.left == VertexSlot::NONE) {
        (true, _) => Cut::Left { left: spoke(undo.left)? },
        (_, true) => Cut::Right { right: spoke(undo.right)? },
        _ => Cut::Both { right: spoke(undo.right)?, left: spoke(undo.left)? },
    };
    fan.admits(cut).then_some(cut)
}

/// A colour near those of `s`, `a` and `b`.
fn color(tape: &mut Tape<'_>, contexts: &mut Contexts, near: [[u8; 3]; 3]) -> [u8; 3] {
    let near = near.map(|color| to_ycocg(color.map(i32::from)));
    let mut surprise = 0;
    let mut out = [0; 3];
    for k in 0..3 {
        let [s, a, b] = near.map(|color| color[k]);
        let spread = s.abs_diff(a) + s.abs_diff(b) + a.abs_diff(b);
        let size = lg(u64::from(spread + surprise + 1)) - 16;
        let residual = tape.scaled_signed(contexts, &format!("color/{k}"), "color/escape", size);
        out[k] = (s + a + b + 1) / 3 + residual;
        surprise = residual.unsigned_abs().min(255) / 2;
    }
    from_ycocg(out).map(|channel| channel.clamp(0, 255) as u8)
}

/// What is added to the position of `s` when the new vertex is at `t`.
fn s_move(
    tape: &mut Tape<'_>,
    contexts: &mut Contexts,
    ring: &Ring,
    t: [i32; 3],
    tangent: i32,
    height: i32,
) -> [i32; 3] {
    if tape.bit(contexts, "move/stays") {
        return [0; 3];
    }
    let away = [0, 1, 2].map(|k| t[k] - ring.origin[k]);
    if tape.bit(contexts, "move/in_middle") {
        return [0, 1, 2].map(|k| {
            let rounding = if t[k] % 2 == 0 { 1 } else { -1 };
            -away[k] + if tape.bit(contexts, "move/parity") { rounding } else { 0 }
        });
    }
    let [u, v, h] = ring.axes;
    let mut out = away.map(|d| -d / 2);
    out[u] += tape.scaled_signed(contexts, "move/across", "move/escape", tangent);
    out[v] += tape.scaled_signed(contexts, "move/along", "move/escape", tangent);
    let above = away[h] + ring.fall(away[u], away[v]);
    let residual = tape.scaled_signed(contexts, "move/height", "move/escape", height);
    out[h] = above - ring.fall(out[u], out[v]) + residual;
    out
}

/// What is added to the colour of `s`: as if the joined vertex had had the colour of its place on the edge.
fn s_color_move(
    tape: &mut Tape<'_>,
    contexts: &mut Contexts,
    before: [u8; 3],
    t: [u8; 3],
    s_move: [i32; 3],
    away: [i32; 3],
) -> [u8; 3] {
    let moved = s_move.map(i64::from);
    let edge = [0, 1, 2].map(|k| i64::from(away[k]) - moved[k]);
    let square = edge.iter().map(|e| e * e).sum::<i64>();
    let of = (0..3).map(|k| -moved[k] * edge[k]).sum::<i64>().clamp(0, square);
    [0, 1, 2].map(|k| {
        let (b, t) = (i64::from(before[k]), i64::from(t[k]));
        let predicted = match square - of {
            0 => 0,
            rest => (b + (b - t) * of / rest).clamp(0, 255) - b,
        };
        let size = lg(b.abs_diff(t) + 1) - 16;
        let residual = tape.scaled_signed(contexts, "color/moved", "color/escape", size);
        (predicted + i64::from(residual)).rem_euclid(256) as u8
    })
}

/// YCoCg-R.
fn to_ycocg([r, g, b]: [i32; 3]) -> [i32; 3] {
    let co = r - b;
    let t = b + (co >> 1);
    let cg = g - t;
    [t + (cg >> 1), co, cg]
}

fn from_ycocg([y, co, cg]: [i32; 3]) -> [i32; 3] {
    let t = y - (cg >> 1);
    let b = t - (co >> 1);
    [b + co, cg + t, b]
}
