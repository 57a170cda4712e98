//! Random sessions and random walks of the codec, to be run by the million ops: both ends must agree after every batch.

use std::collections::BTreeSet;
use std::num::NonZeroU16;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use fastrand::Rng;
use lodestream_protocol::mesh::Patch;
use lodestream_protocol::op::{OpState, decode_batch, random_batch};
use lodestream_protocol::testing::{OperationRng, base_meshes, check_replica};
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_server::ingest::simplify::{BuildOptions, PlacementChoice, Precision};
use lodestream_server::ingest::{Dependencies, Rules};
use lodestream_server::mesh::TriMesh;

use crate::meshes::{self, every_topology};
use crate::model::TestModel;
use crate::naive::{CompleteMesh, keyed, ops_for_view};
use crate::sim::{Disk, LinkShape, Pair, PairConfig, random_view};

/// Of so many checks that cost more than the session itself, one is done.
const RARE: u32 = 24;

/// What a session or a walk did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Done {
    /// Ops that crossed the link.
    pub ops: u64,
    /// Batches after which both ends were compared.
    pub batches: u64,
    /// Meshes compared with the one that the applied ops define.
    pub meshes: u64,
}

impl std::ops::AddAssign for Done {
    fn add_assign(&mut self, other: Self) {
        self.ops += other.ops;
        self.batches += other.batches;
        self.meshes += other.meshes;
    }
}

struct Subject {
    name: String,
    test: TestModel,
    complete: OnceLock<CompleteMesh>,
}

/// What sessions are about: models of every topology in every placement, and some with many components or ops.
pub struct Soak {
    subjects: Vec<Subject>,
    patches: Vec<Patch>,
}

impl Soak {
    /// Builds the models: `small` ones in a moment, all in seconds.
    pub fn new(small: bool) -> Self {
        let mut kinds: Vec<(&'static str, TriMesh)> = every_topology();
        match small {
            true => kinds.retain(|(_, mesh)| mesh.faces.len() < 2000),
            false => kinds.extend([
                ("debris", meshes::debris(400, 3)),
                ("more noise", meshes::noisy_sphere(12_000, 4)),
                ("more colours", meshes::colored_sphere(5)),
                ("a plane", meshes::grid(90, 70)),
                ("many holes", meshes::grid_with_holes(5, 8)),
            ]),
        }
        let mut subjects = Vec::new();
        let vertices = Rules { dependencies: Dependencies::Vertices, ..Rules::default() };
        for (name, mesh) in kinds {
            for (i, placement) in (0..).zip(PlacementChoice::ALL) {
                let bits = [None, Some(12), Some(14)][(subjects.len() + i) % 3];
                let precision = if subjects.len() % 2 == 0 { Precision::Visual } else { Precision::Exact };
                let rules = [Rules::default(), vertices, Rules::PAPER][(subjects.len() / 2 + i) % 3];
                let options = BuildOptions { bits, placement, precision, rules, ..BuildOptions::default() };
                let test = TestModel::with_options(mesh.clone(), &options);
                subjects.push(Subject {
                    name: format!("{name}, {placement:?}, {precision:?}, {rules:?}"),
                    test,
                    complete: OnceLock::new(),
                });
            }
        }
        Self { subjects, patches: base_meshes().into_iter().map(|(_, patch)| patch).collect() }
    }

    /// Runs the session or walk of this number: the same each time.
    ///
    /// # Panics
    /// If the two ends differ, or differ from what they should hold.
    pub fn run(&self, number: u64) -> Done {
        if number % 4 == 3 { self.walk(number) } else { self.session(number) }
    }

    /// Random legal ops, whatever a server would choose, from a generated mesh on.
    fn walk(&self, number: u64) -> Done {
        let mut rng = OperationRng::new(number);
        let base = &self.patches[rng.below(self.patches.len() as u32) as usize];
        let capacity = [0, rng.below(60), rng.below(5000), 1 << 16][rng.below(4) as usize];
        let (has_colors, has_moves) = (rng.one_in(2), rng.one_in(2));
        let step = NonZeroU16::new(rng.below(4) as u16);
        let server = OpState::new(base, 12, has_colors, has_moves, capacity).expect("the base is a manifold");
        let mut server = server.with_step(step);
        let mut client = server.clone();
        let limit = [40 + rng.below(400), 2000 + rng.below(8000)][rng.below(2) as usize];
        let mut done = Done::default();
        let mut next_id = 0;
        for batch in 0..60 {
            let (bytes, counts) = random_batch(&mut rng, &mut server, &self.patches, limit, &mut next_id);
            let decoded = decode_batch(&bytes, &mut client, limit);
            assert_eq!(decoded, Ok(counts), "batch {batch}");
            assert_eq!(client.replica().digest(), server.replica().digest(), "batch {batch}");
            if rng.one_in(RARE / 2) {
                assert_eq!(client.difference(&server), None, "batch {batch}");
            }
            done.ops += u64::from(counts.total());
            done.batches += 1;
        }
        assert_eq!(client.difference(&server), None);
        if rng.one_in(RARE) {
            check_replica(client.replica()).expect("the replica is sound");
        }
        done
    }

    /// A client on a link that looks around, with damage on the way now and then.
    fn session(&self, number: u64) -> Done {
        let mut rng = Rng::with_seed(number);
        let subject = &self.subjects[rng.usize(0..self.subjects.len())];
        let model = &subject.test.model;
        let mut pair = self.pair(&mut rng, subject);
        let mut done = Done::default();
        let what = |step: usize| format!("{}, step {step}", subject.name);
        for step in 0..rng.usize(4..16) {
            if rng.u32(0..12) == 0 && pair.client.stats().resets < 3 {
                pair.damage_a_batch();
            }
            if rng.u32(0..8) == 0 {
                pair.cut();
            }
            let path = path(&mut rng, model.info());
            let is_hurried = rng.u8(0..3) == 0;
            for view in &path {
                pair.look(view.clone());
                // Change one's mind in the middle.
                if is_hurried {
                    pair.run(Duration::from_millis(rng.u64(0..120)));
                    if rng.u32(0..6) == 0 {
                        pair.cut();
                    }
                } else {
                    pair.settle();
                }
            }
            if is_hurried {
                continue;
            }
            let (mirror, replica) = (pair.server.mirror(), pair.client.replica());
            let (mirror, replica) = mirror.zip(replica).expect("the session goes on");
            let view = path.last().expect("a path has views");
            assert_eq!(mirror.digest(), replica.digest(), "{}", what(step));
            let rests = rng.u8(0..4) == 0;
            assert!(replica.triangle_count() <= view.triangle_limit, "{}", what(step));
            if rng.u32(0..RARE / 4) == 0 {
                // What was last in a free slot is forgotten by a mirror that has rested.
                let same = |v: u32| {
                    let v = v as usize;
                    mirror.positions()[v] == replica.positions()[v] && mirror.colors()[v] == replica.colors()[v]
                };
                assert!(replica.vertices().iter().all(same), "{}", what(step));
                let faces = mirror.corners().len().min(replica.corners().len());
                let has_face = |corners: [u32; 3]| corners != [0; 3];
                assert!(mirror.corners().take(faces).eq(replica.corners().take(faces)), "{}", what(step));
                assert!(!mirror.corners().skip(faces).any(has_face), "{}", what(step));
                assert!(!replica.corners().skip(faces).any(has_face), "{}", what(step));
            }
            if rng.u32(0..RARE) == 0 {
                let complete = subject.complete.get_or_init(|| CompleteMesh::new(model).0);
                let applied = pair.server.applied_ops();
                let set: BTreeSet<u32> = applied.iter().map(|op| op.0).collect();
                assert_eq!(set, ops_for_view(model, view), "{}", what(step));
                assert_eq!(keyed(model, replica, &applied), complete.mesh_of(&set), "{}", what(step));
                done.meshes += 1;
            }
            if rests {
                pair.server.rest();
            }
        }
        let stats = pair.client.stats();
        done.ops = stats.splits + stats.collapses + stats.spawns + stats.despawns;
        done.batches = stats.batches;
        done
    }

    fn pair(&self, rng: &mut Rng, subject: &Subject) -> Pair {
        let mut config = PairConfig::default();
        config.client.cache_entries = [None, Some(0), Some(rng.u32(1..100)), Some(10_000)][rng.usize(0..4)];
        if rng.u8(0..3) == 0 {
            let latency = Duration::from_millis(rng.u64(0..100));
            let shape = LinkShape { bytes_per_sec: 10f64.powf(4.5 + 2.0 * rng.f64()), latency };
            (config.down, config.up) = (shape, shape);
        }
        if rng.u8(0..8) > 0 {
            return Pair::new(subject.test.model.clone(), config);
        }
        let latency = Duration::from_millis(rng.u64(0..30));
        config.disk = Disk::Slow { seed: rng.u64(..), latency };
        Pair::new(Arc::clone(&subject.test.reopened()), config)
    }
}

/// A jump, or the way from one random view to another.
fn path(rng: &mut Rng, info: &lodestream_protocol::message::ModelInfo) -> Vec<View> {
    let to = random_view(rng, info);
    if rng.u8(0..3) > 0 {
        return vec![to];
    }
    let from = random_view(rng, info);
    let steps = rng.u32(2..20);
    let at = |i: u32| {
        let mut view = to.clone();
        let share = f64::from(i) / f64::from(steps);
        view.eye = std::array::from_fn(|k| from.eye[k] + (to.eye[k] - from.eye[k]) * share);
        if rng.u8(0..10) == 0 {
            view.triangle_limit = if rng.bool() { UNLIMITED_TRIANGLES } else { info.smallest_limit + rng.u32(0..500) };
        }
        view
    };
    let mut views: Vec<View> = (1..steps).map(at).collect();
    views.push(to);
    views
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_few_sessions_of_each_kind_agree() {
        let soak = Soak::new(true);
        let mut done = Done::default();
        (0..40).for_each(|number| done += soak.run(number));
        assert!(done.ops > 10_000, "{done:?}");
        assert_eq!(soak.run(7), soak.run(7), "a number stands for one walk");
        assert_eq!(soak.run(8), soak.run(8), "a number stands for one session");
    }
}
