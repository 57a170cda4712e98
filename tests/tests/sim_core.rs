//! The properties on which everything else stands, on generated meshes of every topology.

use std::collections::BTreeSet;
use std::time::Duration;

use fastrand::Rng;
use glam::DVec3;
use lodestream_protocol::testing::check_replica;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_server::ingest::simplify::{BuildOptions, PlacementChoice};
use lodestream_server::ingest::{Dependencies, Rules};
use lodestream_server::pack::PAGE_OPS;
use lodestream_server::session::SessionConfig;
use lodestream_server::session::score::Scorer;
use lodestream_tests::meshes::{self, every_topology};
use lodestream_tests::model::TestModel;
use lodestream_tests::naive::{CompleteMesh, Walker, keyed, ops_for_view, parents, triangles};
use lodestream_tests::sim::{Disk, LinkShape, Pair, PairConfig, random_view};

/// Every generated mesh in every placement, and by the paper's rules.
fn every_model(bits: Option<u8>) -> impl Iterator<Item = (String, TestModel)> {
    let placed = PlacementChoice::ALL.map(|placement| (placement, Rules::default()));
    let vertices = Rules { dependencies: Dependencies::Vertices, ..Rules::default() };
    let ruled = [vertices, Rules::PAPER].map(|rules| (PlacementChoice::Endpoint, rules));
    let variants = [&placed[..], &ruled].concat();
    every_topology().into_iter().flat_map(move |(name, mesh)| {
        let model = move |&(placement, rules): &(PlacementChoice, Rules)| {
            let options = BuildOptions { bits, placement, rules, ..BuildOptions::default() };
            (format!("{name}, {placement:?}, {rules:?}"), TestModel::with_options(mesh.clone(), &options))
        };
        variants.iter().map(model).collect::<Vec<_>>()
    })
}

#[test]
fn complete_refinement_is_the_input() {
    for (name, test) in every_model(None) {
        let (_, triangles) = CompleteMesh::new(&test.model);
        assert_eq!(triangles, test.expected_triangles(), "{name}");
    }
}

/// Random legal walks to the same set give the same mesh, which is the one that the set defines; an op may be undone
/// exactly when no applied op has it as a parent.
#[test]
fn the_mesh_is_a_function_of_the_applied_set() {
    for (name, test) in every_model(Some(12)) {
        let model = &*test.model;
        let (complete, _) = CompleteMesh::new(model);
        for seed in 0..3 {
            let mut rng = Rng::with_seed(seed);
            let mut walker = Walker::new(model);
            let ops: Vec<u32> = (0..model.op_count()).collect();
            for phase in 0..6 {
                let growing = phase % 2 == 0;
                for _ in 0..ops.len() * 2 {
                    let Some(&op) = rng.choice(&ops) else { break };
                    if growing && walker.may_apply(op) {
                        walker.apply(op);
                    } else if !growing && walker.slots.contains_key(&op) && rng.bool() {
                        let is_free = !ops
                            .iter()
                            .filter(|other| walker.slots.contains_key(other))
                            .any(|&other| parents(model, other).contains(&op));
                        assert_eq!(walker.undo(op), is_free, "{name} {seed}: undoing {op}");
                    }
                    if ops.len() > 300 && rng.usize(0..ops.len()) == 0 {
                        break;
                    }
                }
                let set: BTreeSet<u32> = walker.slots.keys().copied().collect();
                assert_eq!(walker.keyed(), complete.mesh_of(&set), "{name} {seed} {phase}: {} ops", set.len());
                check_replica(&walker.replica).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
            }
        }
    }
}

/// Settled means P*, by a dull full computation, whatever came before; mirror, client and the mesh that the set defines are
/// the same; the limit holds after every op.
#[test]
fn sessions_settle_on_what_the_view_asks_for() {
    for (name, test) in every_model(Some(13)) {
        let model = &test.model;
        let (complete, _) = CompleteMesh::new(model);
        for seed in 0..3 {
            let mut rng = Rng::with_seed(100 + seed);
            let mut config = PairConfig::default();
            config.client.cache_entries = [None, Some(0), Some(20), Some(10_000)][rng.usize(0..4)];
            if seed == 2 {
                config.down = LinkShape { bytes_per_sec: 50_000.0, latency: Duration::from_millis(40) };
                config.up = LinkShape { bytes_per_sec: 50_000.0, latency: Duration::from_millis(40) };
            }
            let mut pair = Pair::new(model.clone(), config);
            for step in 0..8 {
                let view = random_view(&mut rng, model.info());
                pair.look(view.clone());
                if rng.u8(0..3) == 0 {
                    // Change one's mind in the middle.
                    pair.run(Duration::from_millis(rng.u64(0..120)));
                    continue;
                }
                pair.settle();
                let what = format!("{name} seed {seed} step {step}");
                let applied = pair.server.applied_ops();
                let set: BTreeSet<u32> = applied.iter().map(|a| a.0).collect();
                assert_eq!(set, ops_for_view(model, &view), "{what}");
                let (mirror, replica) = (pair.server.mirror().unwrap(), pair.client.replica().unwrap());
                assert_eq!(mirror.digest(), replica.digest(), "{what}");
                assert_eq!(keyed(model, replica, &applied), complete.mesh_of(&set), "{what}");
                assert!(replica.triangle_count() <= view.triangle_limit, "{what}");
                if view.complete && view.triangle_limit == UNLIMITED_TRIANGLES {
                    assert_eq!(triangles(replica), test.expected_triangles(), "{what}");
                }
            }
            check_replica(pair.client.replica().unwrap()).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
        }
    }
}

/// A session that rests at random moments, in the middle of a view too, leads its client to the same meshes as one that never
/// does: the sets of ops, the meshes that they define, and every digest on the way, which the client checks.
#[test]
fn a_session_that_rests_is_as_good_as_one_that_does_not() {
    for (name, test) in every_model(Some(13)) {
        let model = &test.model;
        let mut wakes = 0;
        for seed in 0..4 {
            let mut rng = Rng::with_seed(300 + seed);
            let mut config = PairConfig::default();
            config.client.cache_entries = [None, Some(0), Some(20), Some(10_000)][seed as usize];
            let mut pair = Pair::new(model.clone(), config);
            let mut awake = Pair::new(model.clone(), config);
            for step in 0..10 {
                let view = random_view(&mut rng, model.info());
                awake.look(view.clone());
                pair.look(view.clone());
                let what = format!("{name} seed {seed} step {step}");
                if rng.bool() {
                    // In the middle: after some of the batches.
                    for _ in 0..rng.u32(0..4) {
                        pair.step(Duration::from_millis(1));
                    }
                    pair.server.rest();
                }
                pair.settle();
                awake.settle();
                match rng.u8(0..3) {
                    0 => pair.server.rest(),
                    // By itself, after a while.
                    1 => {
                        pair.run(SessionConfig::default().rest_after + Duration::from_secs(1));
                        assert!(pair.server.mirror().is_none(), "{what}");
                    }
                    _ => {}
                }
                awake.now = pair.now.max(awake.now);
                let set = |pair: &Pair| pair.server.applied_ops().iter().map(|a| a.0).collect::<BTreeSet<u32>>();
                assert_eq!(set(&pair), set(&awake), "{what}");
                let mesh = |pair: &Pair| keyed(model, pair.client.replica().unwrap(), &pair.server.applied_ops());
                assert_eq!(mesh(&pair), mesh(&awake), "{what}");
            }
            assert_eq!(pair.client.stats().resets, 0);
            check_replica(pair.client.replica().unwrap()).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
            wakes += pair.server.stats().wakes;
        }
        assert!(wakes > 4, "{name}: {wakes}");
    }
}

/// A session whose connection breaks at any moment, again and again, leads its client to the same meshes as one whose never does:
/// `Pair` compares batches sent again with what they were, and the client checks every digest and number.
#[test]
fn a_session_that_is_cut_goes_on_as_one_that_is_not() {
    let (mut cuts, mut again) = (0, 0);
    for (name, test) in every_model(Some(13)) {
        let model = &test.model;
        let (mut lost, mut resumed) = (0, 0);
        for seed in 0..4 {
            let mut rng = Rng::with_seed(700 + seed);
            let mut config = PairConfig::default();
            config.client.cache_entries = [None, Some(0), Some(20), Some(10_000)][seed as usize];
            config.client.apply_on_arrival = true;
            if seed > 0 {
                let shape = LinkShape { bytes_per_sec: 60_000.0, latency: Duration::from_millis(30) };
                (config.down, config.up) = (shape, shape);
            }
            let mut pair = Pair::new(model.clone(), config);
            let mut whole = Pair::new(model.clone(), config);
            for step in 0..10 {
                let view = random_view(&mut rng, model.info());
                whole.look(view.clone());
                pair.look(view.clone());
                let what = format!("{name} seed {seed} step {step}");
                for _ in 0..rng.u32(0..6) {
                    pair.run(Duration::from_micros(rng.u64(0..60_000)));
                    pair.cut();
                    if rng.bool() {
                        // Again before anything could come.
                        pair.run(Duration::from_millis(rng.u64(0..400)));
                        pair.cut();
                    }
                }
                pair.settle();
                whole.settle();
                whole.now = pair.now.max(whole.now);
                pair.now = whole.now;
                let set = |pair: &Pair| pair.server.applied_ops().iter().map(|a| a.0).collect::<BTreeSet<u32>>();
                assert_eq!(set(&pair), set(&whole), "{what}");
                assert_eq!(set(&pair), ops_for_view(model, &view), "{what}");
                let mesh = |pair: &Pair| keyed(model, pair.client.replica().unwrap(), &pair.server.applied_ops());
                assert_eq!(mesh(&pair), mesh(&whole), "{what}");
            }
            let stats = pair.client.stats();
            assert_eq!((stats.resets, stats.dropped_batches), (0, 0), "{name} {seed}");
            assert_eq!(pair.server.stats().resumes > 0, stats.resumed > 0, "{name} {seed}");
            check_replica(pair.client.replica().unwrap()).unwrap_or_else(|e| panic!("{name} {seed}: {e}"));
            (lost, resumed) = (lost + stats.connections_lost, resumed + stats.resumed);
            again += pair.sent_again();
        }
        assert!(resumed > 20 && resumed <= lost, "{name}: {resumed} of {lost}");
        cuts += lost;
    }
    assert!(cuts > 2000 && again > 100, "{cuts} cuts, {again} batches sent again");
}

/// A server that has forgotten the session gives a new one. Until it shows as much as the mesh from before, that one is shown.
#[test]
fn a_forgotten_session_begins_anew_behind_the_old_picture() {
    let test = TestModel::new(meshes::colored_sphere(4), None);
    let slow = LinkShape { bytes_per_sec: 20_000.0, latency: Duration::from_millis(20) };
    let mut pair = Pair::new(test.model.clone(), PairConfig { down: slow, up: slow, ..PairConfig::default() });
    let mut view = random_view(&mut Rng::with_seed(3), test.model.info());
    (view.complete, view.triangle_limit, view.tolerance_px) = (true, UNLIMITED_TRIANGLES, 0.0);
    pair.look(view);
    pair.settle();
    let (digest, generation) = (pair.client.replica().unwrap().digest(), pair.client.generation());
    pair.client.replica_mut().unwrap().track_dirty();
    pair.cut_and_forget();
    let mut restarting = 0;
    loop {
        assert!(pair.step(Duration::from_millis(5)));
        if pair.client.is_restarting() {
            restarting += 1;
            assert_eq!(pair.client.replica().unwrap().digest(), digest, "the old picture stays");
            assert_eq!(pair.client.generation(), generation);
            // Another break on the way changes nothing.
            if restarting == 20 {
                pair.cut();
            }
        } else if restarting > 0 {
            break;
        }
    }
    assert!(restarting > 40, "{restarting}");
    assert_eq!(pair.client.generation(), generation + 1, "one new mesh, when it is as good");
    assert!(pair.client.replica_mut().unwrap().dirty_mut().is_some());
    pair.settle();
    assert_eq!(pair.client.replica().unwrap().digest(), digest);
    let stats = pair.client.stats();
    assert_eq!((stats.connections_lost, stats.resumed, stats.restarted), (2, 1, 1));
}

/// Where pages are read ahead, they may arrive in any order and at any time: what settles is P* all the same, and the session
/// never read a page itself, which `Pair` asserts after each of its calls.
#[test]
fn the_order_in_which_pages_arrive_makes_no_difference() {
    let many_pages = [
        ("debris", meshes::debris(2000, 3), None),
        ("more noise", meshes::noisy_sphere(9000, 4), Some(14)),
        ("more colours", meshes::colored_sphere(5), None),
    ];
    for (name, mesh, bits) in every_topology().into_iter().map(|(name, mesh)| (name, mesh, Some(13))).chain(many_pages)
    {
        let test = TestModel::new(mesh, bits);
        for seed in 0..3 {
            let mut rng = Rng::with_seed(200 + seed);
            let latency = Duration::from_millis([0, 3, 40][seed as usize]);
            let mut config = PairConfig { disk: Disk::Slow { seed, latency }, ..PairConfig::default() };
            if seed == 1 {
                config.down = LinkShape { bytes_per_sec: 200_000.0, latency: Duration::from_millis(20) };
            }
            let mut pair = Pair::new(test.reopened(), config);
            for step in 0..5 {
                let view = random_view(&mut rng, test.model.info());
                pair.look(view.clone());
                if rng.u8(0..3) == 0 {
                    pair.run(Duration::from_millis(rng.u64(0..120)));
                    continue;
                }
                pair.settle();
                let what = format!("{name} seed {seed} step {step}");
                let set: BTreeSet<u32> = pair.server.applied_ops().iter().map(|a| a.0).collect();
                assert_eq!(set, ops_for_view(&test.model, &view), "{what}");
                let (mirror, replica) = (pair.server.mirror().unwrap(), pair.client.replica().unwrap());
                assert_eq!(mirror.digest(), replica.digest(), "{what}");
                assert!(replica.triangle_count() <= view.triangle_limit, "{what}");
            }
            let mut view = random_view(&mut rng, test.model.info());
            (view.complete, view.triangle_limit) = (true, UNLIMITED_TRIANGLES);
            pair.look(view);
            pair.settle();
            assert_eq!(triangles(pair.client.replica().unwrap()), test.expected_triangles(), "{name} seed {seed}");
            let pages = test.model.page_count() + test.model.spawn_count().div_ceil(PAGE_OPS);
            assert_eq!(pair.pages_read(), pages, "{name} seed {seed}");
        }
    }
}

/// Components appear in the order of how large they look: cut where one batch ends and the next begins, the spawns of a view by
/// priority, all judged and sorted, are those that arrived, batch by batch. None of the batches is much larger than allowed.
#[test]
fn components_arrive_by_their_size_on_screen() {
    let test = TestModel::new(meshes::debris(1500, 5), None);
    let model = &test.model;
    assert_eq!(model.spawn_count(), 1500);
    for disk in [Disk::Instant, Disk::Slow { seed: 1, latency: Duration::ZERO }] {
        for (tolerance, limit) in [(1.0, UNLIMITED_TRIANGLES), (0.5, UNLIMITED_TRIANGLES), (0.5, 9000)] {
            let slow = LinkShape { bytes_per_sec: 20_000.0, latency: Duration::from_millis(20) };
            let config = PairConfig { down: slow, up: slow, disk, ..PairConfig::default() };
            let mut pair = Pair::new(test.reopened(), config);
            pair.keep_frames();
            let mut view = View::perspective(DVec3::new(3.0, 2.0, 9.0), DVec3::ZERO, 0.8);
            (view.near, view.tolerance_px, view.triangle_limit) = (1e-3, tolerance, limit);
            pair.look(view.clone());
            let mut arrived: Vec<BTreeSet<u32>> = Vec::new();
            let mut before = BTreeSet::new();
            while pair.client.settled().is_none() {
                assert!(pair.step(Duration::from_millis(5)), "it settles sooner or later");
                let spawned = |&(op, _): &(u32, u32)| (op < model.spawn_count()).then_some(op);
                let now: BTreeSet<u32> = pair.server.applied_ops().iter().filter_map(spawned).collect();
                assert!(before.is_subset(&now), "nothing that came goes again");
                arrived.extend(Some(&now - &before).filter(|new| !new.is_empty()));
                before = now;
            }
            let wanted = ops_for_view(model, &view);
            let scorer = Scorer::new(&view, model.info());
            let priority = |op: u32| scorer.priority(&model.bounds(op).unwrap());
            let mut expected: Vec<u32> = wanted.into_iter().filter(|&op| op < model.spawn_count()).collect();
            expected.sort_by(|&a, &b| priority(b).total_cmp(&priority(a)).then(a.cmp(&b)));
            assert!(
                arrived.len() >= 2,
                "one batch has no order: {} batches with {} spawns, {disk:?} {tolerance} {limit}",
                arrived.len(),
                expected.len()
            );
            assert_eq!(arrived.iter().map(BTreeSet::len).sum::<usize>(), expected.len());
            // Without a limit all that is known to be wanted is sent, also before what is not known yet.
            if limit != UNLIMITED_TRIANGLES || matches!(disk, Disk::Instant) {
                let mut rest = &expected[..];
                for batch in &arrived {
                    let (first, others) = rest.split_at(batch.len());
                    assert_eq!(batch, &first.iter().copied().collect(), "{disk:?} {tolerance} {limit}");
                    rest = others;
                }
                assert_eq!(pair.client.stats().collapses, 0, "nothing is sent in vain");
            }
            let [frames, _] = pair.kept_frames();
            let longest = frames.iter().map(Vec::len).max().unwrap_or_default();
            assert!(longest < 6000, "a frame of {longest} bytes on a link with a window of 16 KB");
        }
    }
}
