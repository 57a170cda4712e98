//! Watching the coder at work: what each bit was spent on, what a batch held, how often each context saw which bit.
//!
//! An observer sits between the models and a decoder, so whatever it tells is about bytes that crossed the wire.

use std::mem::take;

use super::range_coder::{BitCoder, Decoder, Prob, Source};
use crate::mesh::{Cut, NewVertex, Patch};

/// What bits of a batch are spent on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(usize)]
pub enum Part {
    /// Counts, ends of rounds, the flag that forgets cuts.
    Control,
    /// Which ops collapse.
    Collapse,
    /// Spawned components: which, and their meshes.
    Spawn,
    /// Which vertices split, for splits that the cache does not hold.
    Address,
    /// Where the fan opens, likewise.
    Cut,
    /// Position of the new vertex, and of `s` where the placement moves it.
    Position,
    /// Colour likewise.
    Color,
    /// Splits that the cache holds: address and cut.
    Cached,
}

impl Part {
    /// All parts in the order of their numbers.
    pub const ALL: [Part; 8] = [
        Part::Control,
        Part::Collapse,
        Part::Spawn,
        Part::Address,
        Part::Cut,
        Part::Position,
        Part::Color,
        Part::Cached,
    ];

    /// Lower-case name.
    pub fn name(self) -> &'static str {
        match self {
            Part::Control => "control",
            Part::Collapse => "collapse",
            Part::Spawn => "spawn",
            Part::Address => "address",
            Part::Cut => "cut",
            Part::Position => "position",
            Part::Color => "color",
            Part::Cached => "cached",
        }
    }
}

/// What the models tell the coder about their work.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Note<'a> {
    /// The bits since the last such note were for this.
    Spent(Part),
    /// A batch begins.
    Batch { forgets_cuts: bool },
    /// A round of collapses, ascending.
    Collapses(&'a [u32]),
    /// A component came.
    Spawn(u32, &'a Patch),
    /// A round of splits follows.
    SplitRound,
    /// A vertex was split.
    Split(u32, Cut, &'a NewVertex),
}

/// Something that watches.
pub(crate) trait Observer {
    /// A bit under a context, which was `before` until the bit changed it.
    fn bit(&mut self, context: &Prob, before: Prob, bit: bool);
    /// A number of `count` bits at even odds.
    fn raw(&mut self, value: u32, count: u32);
    /// What the models say.
    fn note(&mut self, note: Note<'_>);
}

/// A coder with an observer.
#[derive(Debug)]
pub(crate) struct Observed<'a, C, O> {
    coder: C,
    observer: &'a mut O,
}

impl<'a, C, O> Observed<'a, C, O> {
    pub(crate) fn new(coder: C, observer: &'a mut O) -> Self {
        Self { coder, observer }
    }
}

impl<C: BitCoder, O: Observer> BitCoder for Observed<'_, C, O> {
    fn bit(&mut self, p: &mut Prob, bit: bool) -> bool {
        let before = *p;
        let bit = self.coder.bit(p, bit);
        self.observer.bit(p, before, bit);
        bit
    }

    fn raw(&mut self, value: u32, count: u32) -> u32 {
        let value = self.coder.raw(value, count);
        self.observer.raw(value, count);
        value
    }

    fn note(&mut self, note: Note<'_>) {
        self.observer.note(note);
    }
}

impl<O: Observer> Source for Observed<'_, Decoder<'_>, O> {
    fn is_overrun(&self) -> bool {
        self.coder.is_overrun()
    }

    fn has_trailing(&self) -> bool {
        self.coder.has_trailing()
    }
}

/// Bits by what they were spent on. Code lengths: their sum is the size of the batches but for at most three bytes each.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Breakdown {
    bits: [f64; Part::ALL.len()],
    pending: f64,
}

impl Breakdown {
    /// Bits spent on `part` so far.
    pub fn bits(&self, part: Part) -> f64 {
        self.bits[part as usize]
    }
}

impl Observer for Breakdown {
    fn bit(&mut self, _: &Prob, before: Prob, bit: bool) {
        self.pending += before.cost(bit);
    }

    fn raw(&mut self, _: u32, count: u32) {
        self.pending += f64::from(count);
    }

    fn note(&mut self, note: Note<'_>) {
        if let Note::Spent(part) = note {
            self.bits[part as usize] += take(&mut self.pending);
        }
    }
}

/// The ops of one batch, free of how they were coded.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BatchTrace {
    /// Whether both ends forgot their cached cuts before.
    pub forgets_cuts: bool,
    /// Addresses collapsed, by round.
    pub collapses: Vec<Vec<u32>>,
    /// Components inserted, with their numbers.
    pub spawns: Vec<(u32, Patch)>,
    /// Vertices split, by round.
    pub splits: Vec<Vec<(u32, Cut, NewVertex)>>,
}

impl Observer for BatchTrace {
    fn bit(&mut self, _: &Prob, _: Prob, _: bool) {}

    fn raw(&mut self, _: u32, _: u32) {}

    fn note(&mut self, note: Note<'_>) {
        match note {
            Note::Spent(_) => {}
            Note::Batch { forgets_cuts } => *self = Self { forgets_cuts, ..Self::default() },
            Note::Collapses(round) => self.collapses.push(round.to_vec()),
            Note::Spawn(id, patch) => self.spawns.push((id, patch.clone())),
            Note::SplitRound => self.splits.push(Vec::new()),
            Note::Split(s, cut, vertex) => {
                if let Some(round) = self.splits.last_mut() {
                    round.push((s, cut, *vertex));
                }
            }
        }
    }
}
