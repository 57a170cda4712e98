//! Learns the numbers of the op codec (`protocol/src/op/trained`): `train FILE... [--apart]`, best in release.
//!
//! Sessions over the meshes and over generated ones give samples. Weights of the predicted position and of the expected sizes
//! are least squares, the scores of cuts are softmaxes fitted by Newton's method, the start of each context is how often
//! it saw a 0 over all sessions, each counting for at most [`SESSION_SPLITS`] splits. The table is written to standard output;
//! `protocol/tests/numbers.rs` then writes it as data. With `--apart`, what each mesh costs with numbers learnt without it, and
//! with even odds, is printed instead.

use std::cell::RefCell;
use std::fmt::Write as _;
use std::path::Path as FilePath;

use anyhow::Context as _;
use lodestream_protocol::mesh::Patch;
use lodestream_protocol::op::training::{CutSample, Sample, Tally};
use lodestream_protocol::op::{
    ArcWeights, BatchEncoder, BatchTrace, CUT_SHAPES, CutWeights, GeometryFeatures, MAX_RANKED_VALENCE, OpState,
    SizeWeights, TRAINED, Trained, canonical_order, decode_base_tallied, decode_batch_tallied, encode_base,
    encode_trace,
};
use lodestream_protocol::view::UNLIMITED_TRIANGLES;
use lodestream_server::ingest::read::read_mesh_in_memory;
use lodestream_server::ingest::simplify::{BuildOptions, PlacementChoice};
use lodestream_server::mesh::TriMesh;
use lodestream_tests::meshes::{colored_sphere, debris, grid_with_holes, noisy_sphere, torus};
use lodestream_tests::model::TestModel;
use lodestream_tests::traces::{Path, SessionTrace};

/// Splits from which a session counts no more than another.
const SESSION_SPLITS: f64 = 20_000.0;
/// Weight of a session over a generated mesh in least squares, where one over a scan has 1.
const GENERATED_WEIGHT: f64 = 0.02;
/// Most samples taken of a session.
const SESSION_SAMPLES: usize = 12_000;

fn main() -> anyhow::Result<()> {
    let (flags, files): (Vec<String>, Vec<String>) = std::env::args().skip(1).partition(|arg| arg.starts_with("--"));
    let mut subjects = Vec::new();
    for file in &files {
        let (mesh, _) = read_mesh_in_memory(FilePath::new(file))?;
        let name = FilePath::new(file).file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        subjects.push(Subject::new(name, 1.0, mesh)?);
    }
    for (name, mesh) in generated() {
        subjects.push(Subject::new(name.into(), GENERATED_WEIGHT, mesh)?);
    }
    if flags.iter().any(|flag| flag == "--apart") {
        for i in 0..files.len() {
            let others: Vec<&Subject> = (0..subjects.len()).filter(|&j| j != i).map(|j| &subjects[j]).collect();
            let apart: &'static Trained = Box::leak(Box::new(train(&others)?));
            let even: &'static Trained =
                Box::leak(Box::new(Trained { priors: &[], patch_priors: &[], ..apart.clone() }));
            for session in &subjects[i].sessions {
                let bits = |trained| {
                    Ok::<_, anyhow::Error>(session.encode(trained, None)? as f64 * 8.0 / session.splits as f64)
                };
                let (shipped, apart, even) = (bits(&TRAINED)?, bits(apart)?, bits(even)?);
                println!(
                    "{:16} {:9} {:8} splits: {even:.2} bits with even odds, {apart:.2} trained without it, {shipped:.2} as shipped",
                    subjects[i].name, session.path, session.splits
                );
            }
        }
        return Ok(());
    }
    let all: Vec<&Subject> = subjects.iter().collect();
    print!("{}", table(&train(&all)?));
    Ok(())
}

/// Meshes that anyone can train on.
fn generated() -> Vec<(&'static str, TriMesh)> {
    vec![
        ("noisy sphere", noisy_sphere(40_000, 3)),
        ("colored sphere", colored_sphere(5)),
        ("torus", torus(120, 60)),
        ("grid with holes", grid_with_holes(3, 60)),
        ("debris", debris(600, 5)),
    ]
}

/// A mesh and sessions over it.
struct Subject {
    name: String,
    sessions: Vec<Session>,
}

/// A sample with the positions of `s` and of the new vertex.
type Placed = (Sample, [i32; 3], [i32; 3]);

struct Session {
    path: String,
    /// In least squares.
    weight: f64,
    trace: SessionTrace,
    ops: Vec<(BatchTrace, u32)>,
    splits: u64,
    samples: Vec<Placed>,
    /// The base, and the mesh after the first batches.
    patches: Vec<Patch>,
}

impl Subject {
    fn new(name: String, weight: f64, mesh: TriMesh) -> anyhow::Result<Self> {
        let mut sessions = Vec::new();
        let exact = TestModel::with_options(mesh.clone(), &BuildOptions { bits: Some(14), ..BuildOptions::default() });
        for path in Path::ALL {
            let limit = if path == Path::Jump { 100_000 } else { UNLIMITED_TRIANGLES };
            sessions.push(Session::new(path.name().into(), weight, SessionTrace::record(&exact, path, limit))?);
        }
        let coarse = TestModel::with_options(mesh.clone(), &BuildOptions { bits: Some(11), ..BuildOptions::default() });
        sessions.push(Session::new(
            "11 bits".into(),
            weight,
            SessionTrace::record(&coarse, Path::Complete, UNLIMITED_TRIANGLES),
        )?);
        for placement in [PlacementChoice::Optimal, PlacementChoice::Subset] {
            if mesh.faces.len() < 200_000 {
                let moving = TestModel::with_options(
                    mesh.clone(),
                    &BuildOptions { bits: Some(14), placement, ..BuildOptions::default() },
                );
                let trace = SessionTrace::record(&moving, Path::Complete, UNLIMITED_TRIANGLES);
                sessions.push(Session::new(format!("{placement:?}").to_lowercase(), weight, trace)?);
            }
        }
        Ok(Self { name, sessions })
    }
}

impl Session {
    fn new(path: String, weight: f64, trace: SessionTrace) -> anyhow::Result<Self> {
        let ops = trace.ops()?;
        let splits = ops.iter().flat_map(|(batch, _)| &batch.splits).map(|round| round.len() as u64).sum::<u64>();
        let mut session = Self { path, weight, trace, ops, splits, samples: Vec::new(), patches: Vec::new() };
        session.patches = session.take_patches()?;
        session.samples = session.take_samples()?;
        Ok(session)
    }

    fn take_patches(&self) -> anyhow::Result<Vec<Patch>> {
        let mut state = self.trace.start();
        let mut patches = vec![self.trace.base.clone()];
        for (batch, limit) in &self.ops {
            if state.replica().triangle_count() > 2_000 {
                break;
            }
            encode_trace(batch, &mut state, *limit)?;
            let replica = state.replica();
            let slots: Vec<u32> = replica.vertices().iter().collect();
            let rank = |slot: u32| slots.binary_search(&slot).expect("corners are vertices") as u32;
            let patch = Patch {
                positions: slots.iter().map(|&slot| replica.positions()[slot as usize]).collect(),
                colors: slots.iter().map(|&slot| replica.colors()[slot as usize]).collect(),
                faces: replica.corners().filter(|c| *c != [0; 3]).map(|c| c.map(rank)).collect(),
            };
            patches.extend(canonical_order(&patch).map(|order| order.apply(&patch)));
        }
        Ok(patches)
    }

    fn take_samples(&self) -> anyhow::Result<Vec<Placed>> {
        let every = (self.splits as usize / SESSION_SAMPLES).max(1);
        let samples = RefCell::new(Vec::new());
        let mut count = 0;
        let mut state = self.trace.start();
        for (batch, limit) in &self.ops {
            let mut encoder = BatchEncoder::new(&mut state, batch.forgets_cuts);
            for round in &batch.collapses {
                encoder.collapse_round(round)?;
            }
            let spawns: Vec<_> = batch.spawns.iter().map(|(id, patch)| (*id, patch)).collect();
            encoder.spawns(&spawns, *limit)?;
            for round in &batch.splits {
                encoder.split_round(&round.iter().map(|split| split.0).collect::<Vec<_>>())?;
                for &(s, cut, vertex) in round {
                    let cached = encoder.counts().cached_splits;
                    count += 1;
                    encoder.split(s, *limit, |replica, fan| {
                        if count % every == 0 {
                            let origin = replica.positions()[s as usize];
                            let sample = Sample::new(replica, s, fan, cut);
                            samples.borrow_mut().push((sample, origin, vertex.position));
                        }
                        Some((cut, vertex))
                    })?;
                    if encoder.counts().cached_splits > cached && count % every == 0 {
                        samples.borrow_mut().pop();
                    }
                }
                encoder.end_split_round();
            }
        }
        Ok(samples.into_inner())
    }

    /// Bytes of the batches as coded with `trained`; `tally` counts what the contexts saw.
    fn encode(&self, trained: &'static Trained, mut tally: Option<&mut Tally>) -> anyhow::Result<usize> {
        let SessionTrace { base, lattice_bits, has_colors, has_moves, cache_entries, .. } = &self.trace;
        let new = || -> anyhow::Result<OpState> {
            let state = OpState::with_trained(trained, base, *lattice_bits, *has_colors, *has_moves, *cache_entries)?;
            Ok(state.with_step(self.trace.visual_step))
        };
        let (mut sender, mut receiver) = (new()?, new()?);
        let mut bytes = 0;
        for (batch, limit) in &self.ops {
            let (coded, _) = encode_trace(batch, &mut sender, *limit)?;
            bytes += coded.len();
            if let Some(tally) = &mut tally {
                decode_batch_tallied(&coded, &mut receiver, *limit, tally)?;
            }
        }
        Ok(bytes)
    }
}

fn train(subjects: &[&Subject]) -> anyhow::Result<Trained> {
    let sessions: Vec<&Session> = subjects.iter().flat_map(|subject| &subject.sessions).collect();
    // Where nothing moves `s`, and generated meshes count little: their vertices lie more regularly than those of scans.
    let weighty: Vec<&Session> = sessions.iter().copied().filter(|session| !session.trace.has_moves).collect();
    let mut trained = Trained {
        cut: fit_cuts(&weighty.iter().copied().filter(|session| session.weight == 1.0).collect::<Vec<_>>())?,
        position: fit_position(&weighty)?,
        tangent_size: TRAINED.tangent_size.clone(),
        height_size: TRAINED.height_size.clone(),
        priors: &[],
        patch_priors: &[],
    };
    [trained.tangent_size, trained.height_size] = fit_sizes(&weighty, &trained.position)?;
    let weights: &'static Trained = Box::leak(Box::new(trained.clone()));
    let mut patch_sums = Sums::default();
    for session in sessions.iter().filter(|session| session.path == Path::Complete.name()) {
        for patch in &session.patches {
            let mut tally = Tally::default();
            let SessionTrace { lattice_bits, has_colors, .. } = session.trace;
            let bytes = encode_base(patch, lattice_bits, has_colors);
            decode_base_tallied(&bytes, lattice_bits, has_colors, &mut tally)?;
            patch_sums.add(&tally.counts, 1.0);
        }
    }
    let patch_contexts = patch_sums.0.len();
    let mut sums = Sums::default();
    for session in sessions {
        let mut tally = Tally::default();
        session.encode(weights, Some(&mut tally))?;
        let weight = (SESSION_SPLITS / session.splits.max(1) as f64).min(1.0);
        let (ops, patches) = tally.counts.split_at(tally.counts.len() - patch_contexts);
        sums.add(ops, weight);
        patch_sums.add(patches, weight);
    }
    trained.priors = sums.priors();
    trained.patch_priors = patch_sums.priors();
    Ok(trained)
}

/// What contexts saw in all sessions.
#[derive(Default)]
struct Sums(Vec<[f64; 2]>);

impl Sums {
    fn add(&mut self, counts: &[[f64; 2]], weight: f64) {
        self.0.resize(counts.len(), [0.0; 2]);
        for (sum, count) in self.0.iter_mut().zip(counts) {
            sum[0] += count[0] * weight;
            sum[1] += count[1] * weight;
        }
    }

    fn priors(&self) -> &'static [u16] {
        // Half a sighting of either for what was hardly seen.
        let chance = |&[zero, one]: &[f64; 2]| (zero + 0.5) / (zero + one + 1.0);
        let fixed = |count| (chance(count) * 65_536.0).round().clamp(64.0, 65_472.0) as u16;
        Box::leak(self.0.iter().map(fixed).collect::<Vec<u16>>().into_boxed_slice())
    }
}

/// Sums of a linear least-squares problem.
struct LeastSquares<const N: usize> {
    matrix: [[f64; N]; N],
    right: [f64; N],
}

impl<const N: usize> LeastSquares<N> {
    fn new() -> Self {
        Self { matrix: [[0.0; N]; N], right: [0.0; N] }
    }

    fn add(&mut self, weight: f64, features: &[f64; N], target: f64) {
        for i in 0..N {
            for j in 0..N {
                self.matrix[i][j] += weight * features[i] * features[j];
            }
            self.right[i] += weight * features[i] * target;
        }
    }

    /// By Gauss-Jordan elimination, with a little ridge for what no sample tells.
    fn solve(mut self) -> anyhow::Result<[f64; N]> {
        let ridge = (0..N).map(|i| self.matrix[i][i]).fold(0.0, f64::max) * 1e-6 + 1e-12;
        for i in 0..N {
            self.matrix[i][i] += ridge;
        }
        for i in 0..N {
            let pivot = self.matrix[i][i];
            self.matrix[i].iter_mut().for_each(|x| *x /= pivot);
            self.right[i] /= pivot;
            for k in (0..N).filter(|&k| k != i) {
                let factor = self.matrix[k][i];
                for j in 0..N {
                    self.matrix[k][j] -= factor * self.matrix[i][j];
                }
                self.right[k] -= factor * self.right[i];
            }
        }
        anyhow::ensure!(self.right.iter().all(|x| x.is_finite()), "least squares have no solution");
        Ok(self.right)
    }
}

fn fixed<const N: usize>(values: [f64; N]) -> [i32; N] {
    values.map(|x| (x * 256.0).round() as i32)
}

/// The centres of the ring's parts along an axis.
fn centers(features: &GeometryFeatures, k: usize) -> [f64; 4] {
    std::array::from_fn(|i| features.sums[i][k] as f64 / features.counts[i].max(1) as f64)
}

fn fit_position(sessions: &[&Session]) -> anyhow::Result<[[i32; 4]; CUT_SHAPES]> {
    let mut problems: [LeastSquares<4>; CUT_SHAPES] = std::array::from_fn(|_| LeastSquares::new());
    for session in sessions {
        for (sample, s, t) in &session.samples {
            let features = &sample.geometry;
            // In units of the mean spoke, so that all scales count alike.
            let weight =
                (-f64::from(features.tangent[0]) / 16.0).exp2() * session.weight / session.samples.len() as f64;
            for k in 0..3 {
                let row = centers(features, k);
                problems[features.shape].add(weight, &row, f64::from(t[k] - s[k]));
            }
        }
    }
    let mut out = [[0; 4]; CUT_SHAPES];
    for (out, problem) in out.iter_mut().zip(problems) {
        *out = fixed(problem.solve()?);
    }
    Ok(out)
}

fn fit_sizes(sessions: &[&Session], position: &[[i32; 4]; CUT_SHAPES]) -> anyhow::Result<[SizeWeights; 2]> {
    const N: usize = 6 + CUT_SHAPES;
    let mut problems = [LeastSquares::<N>::new(), LeastSquares::new()];
    for session in sessions {
        for (sample, s, t) in &session.samples {
            let features = &sample.geometry;
            let residual: [f64; 3] = std::array::from_fn(|k| {
                let weights = position[features.shape];
                let point: f64 = centers(features, k).iter().zip(weights).map(|(x, w)| x * f64::from(w)).sum();
                f64::from(t[k] - s[k]) - point / 256.0
            });
            let [u, v, h] = sample.axes;
            let normal = sample.normal.map(f64::from);
            let fall =
                if normal[h] == 0.0 { 0.0 } else { (normal[u] * residual[u] + normal[v] * residual[v]) / normal[h] };
            let octaves = |x: f64| 16.0 * (x + 0.5).log2();
            let targets = [((residual[u].powi(2) + residual[v].powi(2)) / 2.0).sqrt(), (residual[h] + fall).abs()];
            for (problem, (target, features_of)) in
                problems.iter_mut().zip(targets.into_iter().zip([&features.tangent, &features.height]))
            {
                let mut row = [0.0; N];
                for (x, &feature) in row.iter_mut().zip(features_of) {
                    *x = f64::from(feature) / 2.0;
                }
                row[6 + features.shape] = 1.0;
                problem.add(session.weight / session.samples.len() as f64, &row, octaves(target));
            }
        }
    }
    let mut out = Vec::new();
    for problem in problems {
        let solved = problem.solve()?;
        out.push(SizeWeights {
            constant: std::array::from_fn(|i| solved[6 + i].round() as i32),
            features: std::array::from_fn(|i| (solved[i] * 256.0).round() as i32),
        });
    }
    let height = out.pop().context("two problems")?;
    Ok([out.pop().context("two problems")?, height])
}

fn cut_features(features: &lodestream_protocol::op::CutFeatures) -> [f64; 5] {
    let area = f64::from(features.area) / 256.0;
    let octaves = |x: i32| f64::from(x) / 32.0;
    [octaves(features.cut_length), octaves(features.inner_length), octaves(features.edge_length), area, area * area]
}

/// For each arc length a softmax over the starts of each sample, fitted by Newton's method.
fn fit_cuts(sessions: &[&Session]) -> anyhow::Result<CutWeights> {
    let samples =
        || sessions.iter().flat_map(|session| session.samples.iter().filter_map(|sample| sample.0.cut.as_ref()));
    let mut arcs = [ArcWeights::default(); MAX_RANKED_VALENCE as usize];
    let mut weights = [0.0; 5];
    for (arc, out) in arcs.iter_mut().enumerate().skip(1) {
        let of_arc: Vec<&CutSample> = samples().filter(|sample| sample.arc as usize == arc).collect();
        // Too few to learn from: those of the arc that is one shorter will do.
        if of_arc.len() >= FEWEST_CUTS {
            weights = fit_starts(&of_arc)?;
        }
        // Scores are in 1/16 bit, features in 1/32 octave and 1/256.
        let per_octave = |w: f64| (w * 16.0 / 32.0 * 256.0).round() as i32;
        let per_share = |w: f64| (w * 16.0 / 256.0 * 256.0).round() as i32;
        *out = ArcWeights {
            cut_length: per_octave(weights[0]),
            inner_length: per_octave(weights[1]),
            edge_length: per_octave(weights[2]),
            area: per_share(weights[3]),
            area_squared: per_share(weights[4]),
        };
    }
    Ok(CutWeights { arcs })
}

/// Samples of an arc length from which its weights are learnt.
const FEWEST_CUTS: usize = 300;

/// Weights in bits that make the chosen starts likeliest.
fn fit_starts(samples: &[&CutSample]) -> anyhow::Result<[f64; 5]> {
    let mut weights = [0.0; 5];
    for _ in 0..12 {
        let mut problem = LeastSquares::<5>::new();
        for sample in samples {
            let features: Vec<[f64; 5]> = sample.starts.iter().map(cut_features).collect();
            let scores: Vec<f64> =
                features.iter().map(|features| features.iter().zip(&weights).map(|(x, w)| x * w).sum()).collect();
            let best = scores.iter().copied().fold(f64::MIN, f64::max);
            let total: f64 = scores.iter().map(|score| (score - best).exp2()).sum();
            let chances: Vec<f64> = scores.iter().map(|score| (score - best).exp2() / total).collect();
            let mean: [f64; 5] = std::array::from_fn(|i| features.iter().zip(&chances).map(|(f, c)| f[i] * c).sum());
            // The curvature of the code length is the features' spread, its slope how far the chosen one is from their mean.
            for (features, chance) in features.iter().zip(&chances) {
                problem.add(*chance, &std::array::from_fn(|i| features[i] - mean[i]), 0.0);
            }
            for i in 0..5 {
                problem.right[i] += (features[sample.chosen][i] - mean[i]) / std::f64::consts::LN_2;
            }
        }
        for (weight, step) in weights.iter_mut().zip(problem.solve()?) {
            *weight += step;
        }
    }
    Ok(weights)
}

/// The source text of `trained`.
fn table(trained: &Trained) -> String {
    let mut out = String::from(
        "//! Written by `cargo run --release -p lodestream-measure --bin train`.\n\nuse super::{ArcWeights, CutWeights, SizeWeights, Trained};\n\n\
         /// As trained.\n#[rustfmt::skip]\npub static TRAINED: Trained = Trained {\n    cut: CutWeights {\n",
    );
    let mut line = |text: String| writeln!(out, "{text}").expect("a string takes all");
    line("        arcs: [".into());
    for ArcWeights { cut_length, inner_length, edge_length, area, area_squared } in &trained.cut.arcs {
        line(format!(
            "            ArcWeights {{ cut_length: {cut_length}, inner_length: {inner_length}, edge_length: {edge_length}, \
             area: {area}, area_squared: {area_squared} }},"
        ));
    }
    line("        ],\n    },\n    position: [".into());
    trained.position.iter().for_each(|weights| line(format!("        {weights:?},")));
    line("    ],".into());
    for (name, SizeWeights { constant, features }) in
        [("tangent_size", &trained.tangent_size), ("height_size", &trained.height_size)]
    {
        line(format!(
            "    {name}: SizeWeights {{\n        constant: {constant:?},\n        features: {features:?},\n    }},"
        ));
    }
    for (name, priors) in [("priors", trained.priors), ("patch_priors", trained.patch_priors)] {
        line(format!("    {name}: &["));
        priors.chunks(20).for_each(|priors| {
            let text: Vec<String> = priors.iter().map(u16::to_string).collect();
            line(format!("        {},", text.join(", ")));
        });
        line("    ],".into());
    }
    line("};".into());
    out
}
