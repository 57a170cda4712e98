//! The dull twin of the decoder: batches read as `PROTOCOL.md` tells it, from the bytes and the file of trained numbers alone.
//! Maps and searches for everything, nothing shared with the codec.

mod coder;
mod patch;
mod split;

use std::collections::{BTreeMap, BTreeSet};

use self::coder::{Coder, PATCH, bit_length, lg, numbers, power, unzigzag};

type Vec3 = [i64; 3];

/// Something that the text calls a fault.
#[derive(Debug)]
pub(super) struct Fault;

fn sub(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|k| a[k] - b[k])
}

fn dot(a: Vec3, b: Vec3) -> i128 {
    (0..3).map(|k| i128::from(a[k]) * i128::from(b[k])).sum()
}

fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The normal at no more than 30 bits, and its dominant axis.
fn shifted(normal: Vec3, bits: i64) -> (Vec3, usize) {
    let largest = normal.iter().map(|x| x.abs()).max().unwrap();
    let normal = normal.map(|x| x >> (bit_length(largest.into()) - bits).max(0));
    let largest = normal.iter().map(|x| x.abs()).max().unwrap();
    (normal, normal.iter().position(|x| x.abs() == largest).unwrap())
}

fn to_ycocg([r, g, b]: Vec3) -> Vec3 {
    let co = r - b;
    let x = b + (co >> 1);
    [x + ((g - x) >> 1), co, g - x]
}

fn from_ycocg([y, co, cg]: Vec3) -> Vec3 {
    let x = y - (cg >> 1);
    let blue = x - (co >> 1);
    [blue + co, cg + x, blue].map(|c| c.clamp(0, 255))
}

#[derive(Default)]
struct Mesh {
    positions: Vec<Vec3>,
    colors: Vec<Vec3>,
    faces: Vec<[i64; 3]>,
}

/// What is cached of a split.
#[derive(Clone, Debug)]
struct Entry {
    age: u64,
    position: Vec3,
    color: Vec3,
    moved: Vec3,
    color_moved: Vec3,
    left: Option<i64>,
    right: Option<i64>,
    is_known: bool,
    nested: Vec<Entry>,
}

fn count(stack: &[Entry]) -> usize {
    stack.iter().map(|entry| 1 + count(&entry.nested)).sum()
}

fn oldest(stack: &[Entry]) -> u64 {
    stack.iter().map(|entry| entry.age.min(oldest(&entry.nested))).min().unwrap_or(u64::MAX)
}

fn remove(stack: &mut Vec<Entry>, age: u64) {
    stack.retain(|entry| entry.age != age);
    stack.iter_mut().for_each(|entry| remove(&mut entry.nested, age));
}

fn forget(stack: &mut [Entry]) {
    for entry in stack {
        entry.is_known = false;
        forget(&mut entry.nested);
    }
}

/// A split that is applied.
#[derive(Clone)]
struct Applied {
    s: i64,
    last_before: Option<i64>,
    moved: Vec3,
    color_moved: Vec3,
}

#[derive(Clone)]
struct Spawned {
    id: i64,
    slots: Vec<i64>,
    faces: i64,
}

/// Right and left spoke.
type Spokes = (Option<i64>, Option<i64>);

/// The state of a client.
#[derive(Clone)]
pub(super) struct Reader {
    coder: Coder,
    bits: i64,
    has_colors: bool,
    has_moves: bool,
    step: i64,
    cache_entries: usize,
    position: BTreeMap<i64, Vec3>,
    color: BTreeMap<i64, Vec3>,
    face: BTreeMap<i64, [i64; 3]>,
    used: BTreeSet<i64>,
    /// By slot, the address of the op that took it.
    owner: BTreeMap<i64, i64>,
    references: BTreeMap<i64, i64>,
    last: BTreeMap<i64, i64>,
    splits: BTreeMap<i64, Applied>,
    spawns: BTreeMap<i64, Spawned>,
    stacks: BTreeMap<i64, Vec<Entry>>,
    clock: u64,
}

impl Reader {
    pub(super) fn new(
        base: &crate::mesh::Patch,
        bits: u8,
        has_colors: bool,
        has_moves: bool,
        step: u16,
        cache_entries: u32,
    ) -> Self {
        let contexts = [numbers("contexts", ""), numbers("patch_contexts", "")].concat();
        let slots = base.positions.len().max(base.faces.len().div_ceil(2)) as i64;
        Self {
            coder: Coder {
                contexts: contexts.into_iter().map(|x| [x; 2]).collect(),
                bytes: Vec::new(),
                at: 0,
                range: 0,
                code: 0,
            },
            bits: bits.into(),
            has_colors,
            has_moves,
            step: step.into(),
            cache_entries: cache_entries as usize,
            position: (0..).zip(base.positions.iter().map(|p| p.map(i64::from))).collect(),
            color: (0..).zip(base.colors.iter().map(|c| c.map(i64::from))).collect(),
            face: (0..).zip(base.faces.iter().map(|f| f.map(i64::from))).collect(),
            used: (0..slots).collect(),
            owner: BTreeMap::new(),
            references: BTreeMap::new(),
            last: BTreeMap::new(),
            splits: BTreeMap::new(),
            spawns: BTreeMap::new(),
            stacks: BTreeMap::new(),
            clock: 0,
        }
    }

    pub(super) fn digest(&self) -> u64 {
        let fold = |a: u64, b: u64| {
            let product = u128::from(a ^ 0x9e37_79b9_7f4a_7c15) * u128::from(b ^ 0xd1b5_4a32_d192_ed03);
            product as u64 ^ (product >> 64) as u64
        };
        let mut sum = 0u64;
        for (&slot, p) in &self.position {
            let [x, y, z] = p.map(|x| u64::from(x as u32));
            let [r, g, b] = self.color[&slot].map(|c| c as u64);
            sum = sum.wrapping_add(fold(fold(slot as u64 | x << 32, y | z << 32), r | g << 8 | b << 16));
        }
        for (&face, c) in &self.face {
            let [a, b, c] = c.map(|c| c as u64);
            sum = sum.wrapping_add(fold(fold(face as u64 | a << 32, b | c << 32), 1 << 32));
        }
        sum
    }

    pub(super) fn batch(&mut self, bytes: &[u8], limit: u32) -> Result<(), Fault> {
        self.coder.start(bytes);
        if self.coder.bit(0) {
            self.stacks.values_mut().for_each(|stack| forget(stack));
        }
        self.collapses()?;
        let spawns = self.coder.number(1 + 97);
        let mut before = -1;
        for _ in 0..spawns {
            before = self.spawn(before)?;
            self.check_limit(limit)?;
        }
        self.splits(limit)?;
        self.coder.end()
    }

    fn check_limit(&self, limit: u32) -> Result<(), Fault> {
        if self.face.len() > limit as usize { Err(Fault) } else { Ok(()) }
    }

    fn gaps(&mut self, count: usize, at: usize, candidates: Vec<i64>) -> Result<Vec<i64>, Fault> {
        let k = self.coder.number(count);
        let mut n = candidates.len() as i64;
        if k > n {
            return Err(Fault);
        }
        let mut recent = 16 * n / k.max(1);
        let (mut next, mut members) = (0, Vec::new());
        for j in (1..=k).rev() {
            let expected = 16 * n / j;
            let class = match recent {
                recent if 8 * recent < expected => 0,
                recent if 2 * recent < expected => 1,
                recent if recent < 2 * expected => 2,
                _ => 3,
            };
            let gap = self.coder.scaled(at + 260 * class, at + 1040, lg(recent.max(1).into()) - 64);
            if gap >= n {
                return Err(Fault);
            }
            recent = (3 * recent + 16 * gap) / 4;
            n -= gap + 1;
            members.push(candidates[next + gap as usize]);
            next += gap as usize + 1;
        }
        Ok(members)
    }

    fn collapses(&mut self) -> Result<(), Fault> {
        let mut candidates = Vec::new();
        for round in 1.. {
            let members = if round == 1 {
                let legal = self.references.iter().filter(|(_, count)| **count == 0).map(|(&address, _)| address);
                let legal = legal.collect();
                self.gaps(1, 292, legal)?
            } else {
                candidates.into_iter().filter(|_| self.coder.bit(2663 + usize::from(round > 2))).collect::<Vec<_>>()
            };
            let mut released = Vec::new();
            for &address in &members {
                match self.spawns.remove(&address) {
                    Some(spawn) => self.despawn(address, &spawn),
                    None => self.collapse(address, &mut released)?,
                }
            }
            released.sort_unstable();
            candidates = released;
            if members.is_empty() || candidates.is_empty() {
                return Ok(());
            }
        }
        unreachable!()
    }

    fn despawn(&mut self, address: i64, spawn: &Spawned) {
        for j in 0..spawn.faces {
            self.face.remove(&(2 * spawn.slots[j as usize / 2] + j % 2));
        }
        for slot in &spawn.slots {
            self.position.remove(slot);
            self.color.remove(slot);
            self.used.remove(slot);
            self.owner.remove(slot);
            self.last.remove(slot);
            self.stacks.remove(slot);
        }
        self.references.remove(&address);
    }

    fn drop_reference(&mut self, address: Option<i64>, released: &mut Vec<i64>) {
        if let Some(address) = address {
            let count = self.references.get_mut(&address).unwrap();
            *count -= 1;
            if *count == 0 {
                released.push(address);
            }
        }
    }

    fn owner_of(&self, face: i64) -> Option<i64> {
        self.owner.get(&(face / 2)).copied()
    }

    fn face_along(&self, a: i64, b: i64) -> Option<i64> {
        let has = |c: &[i64; 3]| (0..3).any(|k| c[k] == a && c[(k + 1) % 3] == b);
        self.face.iter().find(|(_, c)| has(c)).map(|(&face, _)| face)
    }

    fn collapse(&mut self, t: i64, released: &mut Vec<i64>) -> Result<(), Fault> {
        let Applied { s, last_before, moved, color_moved } = self.splits.remove(&t).ok_or(Fault)?;
        let [f_l, f_r] = [self.face.remove(&(2 * t)), self.face.remove(&(2 * t + 1))];
        let (left, right) = (f_l.map(|f| f[2]), f_r.map(|f| f[2]));
        let edges = left.iter().flat_map(|&l| [(l, t), (s, l)]).chain(right.iter().flat_map(|&r| [(r, s), (t, r)]));
        for (a, b) in edges {
            let owner = self.face_along(a, b).and_then(|face| self.owner_of(face));
            self.drop_reference(owner, released);
        }
        self.drop_reference(last_before, released);
        match last_before {
            Some(op) => self.last.insert(s, op),
            None => self.last.remove(&s),
        };
        self.last.remove(&t);
        self.face.values_mut().flatten().filter(|c| **c == t).for_each(|c| *c = s);
        let (position, color) = (self.position.remove(&t).unwrap(), self.color.remove(&t).unwrap());
        self.shift(s, moved.map(|x| -x), color_moved.map(|x| -x));
        self.used.remove(&t);
        self.owner.remove(&t);
        self.references.remove(&t);

        let mut nested = self.stacks.remove(&t).unwrap_or_default();
        if self.cache_entries > 0 {
            if self.stacks.values().map(|stack| count(stack)).sum::<usize>() + count(&nested) == self.cache_entries {
                let age =
                    self.stacks.values().map(|stack| oldest(stack)).min().unwrap_or(u64::MAX).min(oldest(&nested));
                self.stacks.values_mut().for_each(|stack| remove(stack, age));
                remove(&mut nested, age);
            }
            self.clock += 1;
            let entry =
                Entry { age: self.clock, position, color, moved, color_moved, left, right, is_known: true, nested };
            self.stacks.entry(s).or_default().push(entry);
        }
        Ok(())
    }

    fn shift(&mut self, slot: i64, by: Vec3, color_by: Vec3) {
        let (p, c) = (self.position[&slot], self.color[&slot]);
        self.position.insert(slot, std::array::from_fn(|k| p[k] + by[k]));
        self.color.insert(slot, std::array::from_fn(|k| (c[k] + color_by[k]) & 255));
    }

    fn take_slot(&mut self) -> i64 {
        let slot = (0..).find(|slot| !self.used.contains(slot)).unwrap();
        self.used.insert(slot);
        slot
    }

    fn spawn(&mut self, before: i64) -> Result<i64, Fault> {
        let gap = self.coder.number(2566) as usize;
        let is_free = |id: &i64| !self.spawns.values().any(|spawn| spawn.id == *id);
        let id = (before + 1..).filter(is_free).nth(gap).unwrap();
        let mesh = self.patch()?;
        let slots: Vec<i64> =
            (0..mesh.positions.len().max(mesh.faces.len().div_ceil(2))).map(|_| self.take_slot()).collect();
        let address = *slots.first().ok_or(Fault)?;
        for (j, (&p, &c)) in mesh.positions.iter().zip(&mesh.colors).enumerate() {
            self.position.insert(slots[j], p);
            self.color.insert(slots[j], c);
            self.last.insert(slots[j], address);
        }
        for (j, face) in mesh.faces.iter().enumerate() {
            self.face.insert(2 * slots[j / 2] + j as i64 % 2, face.map(|v| slots[v as usize]));
        }
        self.owner.extend(slots.iter().map(|&slot| (slot, address)));
        self.references.insert(address, 0);
        self.spawns.insert(address, Spawned { id, slots, faces: mesh.faces.len() as i64 });
        Ok(id)
    }

    fn splits(&mut self, limit: u32) -> Result<(), Fault> {
        let mut roles = BTreeMap::new();
        for round in 1.. {
            let members: Vec<i64> = if round == 1 {
                let all = self.position.keys().copied().collect();
                self.gaps(1 + 2 * 97, 1429, all)?
            } else {
                let mut members = Vec::new();
                for (&v, &roles) in &roles {
                    let cached = usize::from(self.stacks.get(&v).is_some_and(|stack| !stack.is_empty()));
                    if self.coder.bit(2665 + (2 * roles + cached) * 2 + usize::from(round > 2)) {
                        members.push(v);
                    }
                }
                members
            };
            if members.is_empty() {
                return Ok(());
            }
            roles.clear();
            for s in members {
                for (v, role) in self.split(s)? {
                    *roles.entry(v).or_insert(0) |= role;
                }
                self.check_limit(limit)?;
            }
        }
        unreachable!()
    }

    fn split(&mut self, s: i64) -> Result<Vec<(i64, usize)>, Fault> {
        let ring = self.ring(s);
        let fits = |(right, left): Spokes| match (right, left) {
            (Some(right), Some(left)) => {
                if ring.is_closed {
                    right != left
                } else {
                    right < left
                }
            }
            _ => !ring.is_closed,
        };
        let top = self.stacks.get(&s).and_then(|stack| stack.last()).cloned();
        let mut cut = None;
        if let Some(top) = top.as_ref().filter(|top| top.is_known) {
            let spoke = |slot: i64| ring.slots.iter().position(|&other| other == slot).map(|i| i as i64);
            let guess = (top.right.and_then(spoke), top.left.and_then(spoke));
            let is_there = guess.0.is_some() == top.right.is_some() && guess.1.is_some() == top.left.is_some();
            if is_there && fits(guess) && self.coder.bit(2729) {
                cut = Some(guess);
            }
        }
        let cut = match cut {
            Some(cut) => cut,
            None => self.cut(&ring),
        };
        if !fits(cut) {
            return Err(Fault);
        }
        let faces = ring.faces.len() as i64;
        let arc = match cut {
            (Some(right), Some(left)) => (left - right).rem_euclid(faces.max(left + 1)),
            (None, left) => left.unwrap(),
            (Some(right), None) => faces - right,
        };
        let entry = match top {
            Some(top) => top,
            None => self.geometry(s, &ring, cut, arc),
        };
        let t = self.take_slot();
        if let Some(stack) = self.stacks.get_mut(&s)
            && stack.pop().is_some()
        {
            self.stacks.insert(t, entry.nested.clone());
        }
        for i in 0..arc {
            let face = ring.faces[((cut.0.unwrap_or(0) + i) % faces) as usize];
            self.face.get_mut(&face).unwrap().iter_mut().filter(|c| **c == s).for_each(|c| *c = t);
        }
        let mut refer = vec![self.last.get(&s).copied()];
        for spoke in [cut.0, cut.1].into_iter().flatten() {
            for i in [spoke - 1, spoke] {
                let i = if ring.is_closed { i.rem_euclid(faces) } else { i };
                let face = usize::try_from(i).ok().and_then(|i| ring.faces.get(i));
                refer.push(face.and_then(|&face| self.owner_of(face)));
            }
        }
        for address in refer.iter().flatten() {
            *self.references.get_mut(address).unwrap() += 1;
        }
        self.references.insert(t, 0);
        let mut roles = vec![(s, 1), (t, 2)];
        if let Some(left) = cut.1 {
            let l = ring.slots[left as usize];
            self.face.insert(2 * t, [s, t, l]);
            roles.push((l, 4));
        }
        if let Some(right) = cut.0 {
            let r = ring.slots[right as usize];
            self.face.insert(2 * t + 1, [t, s, r]);
            roles.push((r, 8));
        }
        let Entry { position, color, moved, color_moved, .. } = entry;
        self.splits.insert(t, Applied { s, last_before: refer[0], moved, color_moved });
        self.last.extend([(s, t), (t, t)]);
        self.owner.insert(t, t);
        self.position.insert(t, position);
        self.color.insert(t, color);
        self.shift(s, moved, color_moved);
        let on_lattice = |p: Vec3| p.iter().all(|x| (0..1 << self.bits).contains(x));
        if on_lattice(position) && on_lattice(self.position[&s]) { Ok(roles) } else { Err(Fault) }
    }
}
