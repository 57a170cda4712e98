//! The paper's rules beside the default: what the same views cost under each, and all of them together.

use anyhow::{Context as _, ensure};
use glam::DVec3;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_server::ingest::simplify::BuildOptions;
use lodestream_server::ingest::{Dependencies, ErrorRule, Rules, Spheres};
use lodestream_server::pack::{PackedModel, inspect};
use lodestream_server::session::ops_for_view;
use lodestream_tests::model::TestModel;
use lodestream_tests::sim::{Pair, PairConfig};
use lodestream_tests::source::Source;

/// Turns of a view: 60 degrees apart.
const AZIMUTHS: u32 = 6;

/// What one set of rules costs on a model.
pub(crate) struct Ruled {
    rules: &'static str,
    distance: &'static str,
    /// Sums over all azimuths.
    ops: u64,
    bytes: u64,
    /// Against the first set of rules.
    ops_ratio: f64,
    bytes_ratio: f64,
    mean_waits: f64,
    depth: u32,
    pack_bytes_per_split: f64,
}

impl Ruled {
    pub(crate) const HEAD: &str = "| model | rules | view | ops | of the default's | kB until settled | of the default's | waits for, mean | depth | pack, B per split |";

    pub(crate) fn row(&self, model: &str) -> String {
        let per_view = |sum: u64| sum as f64 / f64::from(AZIMUTHS);
        format!(
            "| {model} | {} | {} | {:.0} | {:.2} | {:.1} | {:.2} | {:.2} | {} | {:.1} |",
            self.rules,
            self.distance,
            per_view(self.ops),
            self.ops_ratio,
            per_view(self.bytes) / 1e3,
            self.bytes_ratio,
            self.mean_waits,
            self.depth,
            self.pack_bytes_per_split
        )
    }
}

/// Each rule by itself, and all.
fn choices() -> [(&'static str, Rules); 5] {
    let default = Rules::default();
    [
        ("default", default),
        ("`--dependencies vertices`", Rules { dependencies: Dependencies::Vertices, ..default }),
        ("`--spheres dag`", Rules { spheres: Spheres::Dag, ..default }),
        ("`--error edge`", Rules { error: ErrorRule::Edge, ..default }),
        ("all three", Rules::PAPER),
    ]
}

pub(crate) fn measure(source: &Source) -> anyhow::Result<Vec<Ruled>> {
    let mut all: Vec<Ruled> = Vec::new();
    for (name, rules) in choices() {
        let test = TestModel::with_options(source.mesh()?, &BuildOptions { rules, ..BuildOptions::default() });
        let found = inspect(&test.model)?;
        let waits: u64 = (0..).zip(&found.parents_histogram).map(|(count, splits): (u64, _)| count * splits).sum();
        for (distance, radii) in [("whole", 1.0 / 22.5f64.to_radians().sin()), ("close", 0.95)] {
            let (mut ops, mut bytes) = (0, 0);
            for azimuth in 0..AZIMUTHS {
                let view = view(&test.model, f64::from(azimuth * 360 / AZIMUTHS), radii);
                let mut pair = Pair::new(test.model.clone(), PairConfig::default());
                pair.look(view.clone());
                pair.settle();
                let stats = pair.client.stats();
                let selected = ops_for_view(&test.model, &view)?.len() as u64;
                ensure!(selected == stats.splits + stats.spawns, "{selected} ops were not what was sent");
                ops += selected;
                bytes += pair.bytes_down();
            }
            let of_default = |value: u64, of: fn(&Ruled) -> u64| {
                let default = all.iter().find(|other| other.distance == distance).map_or(value, of);
                value as f64 / default as f64
            };
            all.push(Ruled {
                rules: name,
                distance,
                ops,
                bytes,
                ops_ratio: of_default(ops, |other| other.ops),
                bytes_ratio: of_default(bytes, |other| other.bytes),
                mean_waits: waits as f64 / f64::from(found.splits.max(1)),
                depth: found.dag_depth,
                pack_bytes_per_split: found.bytes_per_split,
            });
        }
    }
    let first = all.first().context("there are rules")?;
    ensure!(first.ops > 0, "nothing was asked for");
    Ok(all)
}

/// One pixel at 1920x1080 and 45 degrees, from so many radii of the model's box.
fn view(model: &PackedModel, degrees: f64, radii: f64) -> View {
    let info = model.info();
    let at =
        |q: [i32; 3]| DVec3::from_array(info.lattice.origin) + DVec3::from_array(q.map(f64::from)) * info.lattice.step;
    let (low, high) = (at(info.box_min), at(info.box_max));
    let (center, radius) = ((low + high) / 2.0, low.distance(high) / 2.0);
    let angle = degrees.to_radians();
    let eye = center + DVec3::new(angle.sin(), 0.0, angle.cos()) * radius * radii;
    View {
        near: 1e-3 * radius,
        aspect: 16.0 / 9.0,
        triangle_limit: UNLIMITED_TRIANGLES,
        ..View::perspective(eye, center, 45f32.to_radians())
    }
}
