//! `paper [--output FOLDER] [FILE...]`: what Southern, Blake and Marais (2001), chapter 5, report, measured here: polygons along a
//! camera path with and without un-refinement (Fig. 5.6), the size of the hierarchy (table in 5.3), and what the cache saves (5.2,
//! "Client Cache"; 5.3), and what its rules cost beside the default (5.1). Writes `paper.md` and `paper-coherence.svg`; prints the former.

mod plot;
mod rules;

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::PathBuf;

use anyhow::{Context as _, ensure};
use glam::DVec3;
use lodestream_client::core::ClientConfig;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_server::ingest::sample;
use lodestream_server::pack::record::CutRef;
use lodestream_server::pack::{PackedModel, inspect, parents_first, replay_ops};
use lodestream_server::session::ops_for_view;
use lodestream_tests::meshes;
use lodestream_tests::model::TestModel;
use lodestream_tests::sim::{Pair, PairConfig};
use lodestream_tests::source::Source;

/// Models measured without being asked for others.
const MESHES: [&str; 2] = ["bunny.ply", "dragon_871k.ply"];
/// Stand in for them.
const MADE: [Source; 2] = [
    Source::Made("noisy-sphere-70k", || meshes::noisy_sphere(70_000, 1)),
    Source::Made("stone-300k", || sample::generate(300_000, 0)),
];
/// Views of the flight, two degrees apart: once around.
const STEPS: u32 = 180;
/// Capacities of the cache, in percent of the model's ops.
const CACHES: [u32; 4] = [0, 1, 5, 20];
/// Bytes of a visibility sphere as the pack has it before its columns are coded: centre, radius, error, axis, half-angle.
const SPHERE_BYTES: u64 = 12 + 2 + 2 + 2 + 1;
/// Bytes of a reference.
const LINK_BYTES: u64 = 4;

fn main() -> anyhow::Result<()> {
    let mut words = std::env::args().skip(1);
    let (mut folder, mut files) = (PathBuf::from("."), Vec::new());
    while let Some(word) = words.next() {
        match word.as_str() {
            "--output" => folder = words.next().context("--output takes a folder")?.into(),
            flag => {
                ensure!(!flag.starts_with('-'), "{flag}: there is --output FOLDER");
                files.push(PathBuf::from(word));
            }
        }
    }
    let sources = if files.is_empty() { Source::of_targets(&MESHES, &MADE)? } else { Source::of_files(files) };
    let mut subjects = Vec::new();
    for source in &sources {
        let test = TestModel::new(source.mesh()?, None);
        let flight = fly(&test).with_context(|| source.name())?;
        let hierarchy = Hierarchy::of(&test.model)?;
        let caches = caches(&test)?;
        let rules = rules::measure(source)?;
        subjects.push(Subject { name: source.name(), flight, hierarchy, caches, rules });
    }
    let text = described(&subjects)?;
    std::fs::create_dir_all(&folder)?;
    std::fs::write(folder.join("paper.md"), &text)?;
    plot::write(&subjects, &folder.join("paper-coherence.svg"))?;
    print!("{text}");
    Ok(())
}

/// What was measured of a model.
struct Subject {
    name: String,
    flight: Vec<Step>,
    hierarchy: Hierarchy,
    caches: Vec<Cached>,
    rules: Vec<rules::Ruled>,
}

/// Triangles after a view of the flight.
struct Step {
    with_collapses: u64,
    without: u64,
}

/// Views once around the model, two degrees apart, nodding; the image shows a part of the surface.
fn flight(test: &TestModel) -> impl DoubleEndedIterator<Item = View> + Clone + use<> {
    let (lo, hi) = test.clean.bounding_box().expect("the mesh has vertices");
    let (lo, hi) = (DVec3::from_array(lo), DVec3::from_array(hi));
    let (center, radius) = ((lo + hi) / 2.0, (hi - lo).length() / 2.0);
    (0..STEPS).map(move |i| {
        let angle = (f64::from(i) * 2.0).to_radians();
        let nod = (3.0 * angle).sin() * 0.25;
        let direction = DVec3::new(angle.sin(), nod, angle.cos()).normalize();
        let target = center + DVec3::Y * (2.0 * angle).sin() * radius * 0.3;
        let mut view = View::perspective(target + direction * radius * 1.5, target, 20f32.to_radians());
        view.near = radius * 1e-3;
        view.triangle_limit = UNLIMITED_TRIANGLES;
        view
    })
}

/// The flight with a real session, every view until it has settled; and the union of what the views ask for, which is what a
/// client holds to which no collapse is ever sent.
fn fly(test: &TestModel) -> anyhow::Result<Vec<Step>> {
    let model = &test.model;
    let mut pair = Pair::new(model.clone(), PairConfig::default());
    let base = model.base().faces.len() as u64;
    let mut seen = BTreeSet::new();
    let mut in_order = Vec::new();
    let mut without = base;
    let mut steps = Vec::new();
    for view in flight(test) {
        pair.look(view.clone());
        pair.settle();
        let with_collapses = u64::from(pair.client.stats().triangles);
        let mut selected = base;
        for op in ops_for_view(model, &view)? {
            let triangles = triangles_of(model, op)?;
            selected += triangles;
            if seen.insert(op) {
                in_order.push(op);
                without += triangles;
            }
        }
        ensure!(selected == with_collapses, "the session settled on {with_collapses} triangles, not {selected}");
        steps.push(Step { with_collapses, without });
    }
    let built = u64::from(replay_ops(model, in_order.into_iter())?.triangle_count());
    ensure!(built == without, "the union is {built} triangles, not {without}");
    Ok(steps)
}

fn triangles_of(model: &PackedModel, op: u32) -> anyhow::Result<u64> {
    if op < model.spawn_count() {
        return Ok(u64::from(model.spawn_triangles(op)?));
    }
    let fields = model.split(op)?;
    Ok(u64::from(fields.left != CutRef::None) + u64::from(fields.right != CutRef::None))
}

/// Both kinds of hierarchy over the same ops.
struct Hierarchy {
    splits: u64,
    split_links: u64,
    most_parents: usize,
    depth: u32,
    vertex_nodes: u64,
    pack_bytes_per_split: f64,
}

impl Hierarchy {
    fn of(model: &PackedModel) -> anyhow::Result<Self> {
        let found = inspect(model)?;
        let (mut parents_sum, mut most_parents) = (0u64, 0);
        parents_first(model, |_, parents| {
            parents_sum += parents.len() as u64;
            most_parents = most_parents.max(parents.len());
            Ok(())
        })?;
        let splits = u64::from(found.splits);
        // A split ends one vertex and begins two, so there are twice as many nodes as splits beside those of roots.
        let roots = found.vertices - splits;
        Ok(Self {
            splits,
            split_links: parents_sum + 2 * splits,
            most_parents,
            depth: found.dag_depth,
            vertex_nodes: roots + 2 * splits,
            pack_bytes_per_split: found.bytes_per_split,
        })
    }

    /// A sphere and the references of each split: its parents and the first splits of its two vertices.
    fn split_bytes(&self) -> u64 {
        self.splits * SPHERE_BYTES + self.split_links * LINK_BYTES
    }

    /// A sphere, parent and first child of each vertex, and the four neighbouring faces of each split (Hoppe 1997).
    fn vertex_bytes(&self) -> u64 {
        self.vertex_nodes * (SPHERE_BYTES + 2 * LINK_BYTES) + self.splits * 4 * LINK_BYTES
    }
}

/// A path with a cache, all after the first view.
struct Cached {
    path: &'static str,
    percent: u32,
    collapses: u64,
    cached: u64,
    splits: u64,
}

impl Cached {
    /// Ops that say which one they are, and nothing else.
    fn without_record(&self) -> f64 {
        (self.collapses + self.cached) as f64 / (self.collapses + self.splits).max(1) as f64
    }
}

fn caches(test: &TestModel) -> anyhow::Result<Vec<Cached>> {
    let mut out = Vec::new();
    let forward: Vec<View> = flight(test).collect();
    let back = forward[..30].iter().chain(forward[..29].iter().rev()).cloned();
    let paths = [
        ("once around", forward.clone()),
        ("60 degrees and back", back.collect()),
        ("twice around", [&forward[..], &forward].concat()),
    ];
    for (path, views) in paths {
        for percent in CACHES {
            let entries = u64::from(test.model.op_count()) * u64::from(percent) / 100;
            let entries = u32::try_from(entries).context("too many ops")?;
            let client = ClientConfig { cache_entries: Some(entries), ..PairConfig::default().client };
            let mut pair = Pair::new(test.model.clone(), PairConfig { client, ..PairConfig::default() });
            let mut first = None;
            for view in &views {
                pair.look(view.clone());
                pair.settle();
                first.get_or_insert_with(|| pair.client.stats().clone());
            }
            ensure!(pair.client.cache_entries() == Some(entries), "the server grants fewer than {entries} entries");
            let (stats, first) = (pair.client.stats(), first.unwrap_or_default());
            out.push(Cached {
                path,
                percent,
                collapses: stats.collapses - first.collapses,
                cached: stats.cached_splits - first.cached_splits,
                splits: stats.splits - first.splits,
            });
        }
    }
    Ok(out)
}

fn described(subjects: &[Subject]) -> anyhow::Result<String> {
    let mut out = String::from(include_str!("head.md"));
    writeln!(out, "## The rules (5.1)\n\n{}\n", include_str!("rules.md").trim_end())?;
    writeln!(out, "{}", rules::Ruled::HEAD)?;
    writeln!(out, "|{}{}", " --- |".repeat(3), " ---: |".repeat(rules::Ruled::HEAD.matches('|').count() - 4))?;
    for Subject { name, rules, .. } in subjects {
        rules.iter().try_for_each(|ruled| writeln!(out, "{}", ruled.row(name)))?;
    }
    writeln!(out)?;
    writeln!(out, "## Coherence (Fig. 5.6)\n\n{}", include_str!("coherence.md").trim_end())?;
    writeln!(out, "\n| model | views | mean with collapses | most | without, at the end | ratio at the end |")?;
    writeln!(out, "| --- | ---: | ---: | ---: | ---: | ---: |")?;
    for Subject { name, flight, .. } in subjects {
        let mean = flight.iter().map(|s| s.with_collapses).sum::<u64>() as f64 / flight.len() as f64;
        let most = flight.iter().map(|s| s.with_collapses).max().unwrap_or(0);
        let last = flight.last().context("a flight has views")?;
        let ratio = last.without as f64 / last.with_collapses as f64;
        writeln!(out, "| {name} | {} | {mean:.0} | {most} | {} | {ratio:.1} |", flight.len(), last.without)?;
    }
    writeln!(out, "\n## The hierarchy (table in 5.3)\n\n{}", include_str!("hierarchy.md").trim_end())?;
    writeln!(
        out,
        "\n| model | vertex nodes | kB | split nodes | kB | ratio of nodes | of sizes | parents, mean | most | depth | pack, B per split |"
    )?;
    writeln!(out, "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")?;
    for Subject { name, hierarchy: h, .. } in subjects {
        let kilo = |bytes: u64| bytes as f64 / 1024.0;
        let mean = (h.split_links - 2 * h.splits) as f64 / h.splits.max(1) as f64;
        writeln!(
            out,
            "| {name} | {} | {:.0} | {} | {:.0} | {:.2} | {:.2} | {mean:.2} | {} | {} | {:.1} |",
            h.vertex_nodes,
            kilo(h.vertex_bytes()),
            h.splits,
            kilo(h.split_bytes()),
            h.splits as f64 / h.vertex_nodes as f64,
            h.split_bytes() as f64 / h.vertex_bytes() as f64,
            h.most_parents,
            h.depth,
            h.pack_bytes_per_split
        )?;
    }
    writeln!(out, "\n## The cache (5.2, 5.3)\n\n{}", include_str!("cache.md").trim_end())?;
    writeln!(
        out,
        "\n| model | path | cache, % of ops | collapses | splits | cached splits | share of splits | ops without record |"
    )?;
    writeln!(out, "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |")?;
    for Subject { name, caches, .. } in subjects {
        for c in caches {
            writeln!(
                out,
                "| {name} | {} | {} | {} | {} | {} | {:.1} % | {:.1} % |",
                c.path,
                c.percent,
                c.collapses,
                c.splits,
                c.cached,
                100.0 * c.cached as f64 / c.splits.max(1) as f64,
                100.0 * c.without_record()
            )?;
        }
    }
    Ok(out)
}
