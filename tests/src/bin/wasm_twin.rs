//! Feeds recorded sessions to the decoder as built for the browser, `wasm_twin MODULE`, and compares the digest with that of
//! this build after every batch.

use anyhow::{Context, Result, ensure};
use lodestream_protocol::op::{decode_batch, encode_base};
use lodestream_protocol::view::UNLIMITED_TRIANGLES;
use lodestream_server::ingest::simplify::{BuildOptions, PlacementChoice, Precision};
use lodestream_tests::meshes;
use lodestream_tests::model::TestModel;
use lodestream_tests::traces::{Path, SessionTrace};
use wasmi::{Engine, Instance, Linker, Module, Store, TypedFunc};

/// The module, running.
struct Twin {
    store: Store<()>,
    push: TypedFunc<u32, ()>,
    base: TypedFunc<(u32, u32, u32, u32, u32), u64>,
    batch: TypedFunc<u32, u64>,
}

impl Twin {
    fn new(bytes: &[u8]) -> Result<Self> {
        let engine = Engine::default();
        let module = Module::new(&engine, bytes).context("not a WebAssembly module")?;
        let mut store = Store::new(&engine, ());
        let instance: Instance = Linker::new(&engine).instantiate_and_start(&mut store, &module)?;
        Ok(Self {
            push: instance.get_typed_func(&store, "push")?,
            base: instance.get_typed_func(&store, "base")?,
            batch: instance.get_typed_func(&store, "batch")?,
            store,
        })
    }

    fn push(&mut self, bytes: &[u8]) -> Result<()> {
        bytes.iter().try_for_each(|&byte| Ok(self.push.call(&mut self.store, byte.into())?))
    }
}

fn main() -> Result<()> {
    let path = std::env::args().nth(1).context("usage: wasm_twin MODULE")?;
    let bytes = std::fs::read(&path).with_context(|| format!("cannot read {path}"))?;
    let mut twin = Twin::new(&bytes).with_context(|| path.clone())?;
    let kinds = [
        ("sphere", meshes::icosphere(3), Path::Orbit),
        ("grid with holes", meshes::grid_with_holes(2, 6), Path::Jump),
        ("components", meshes::many_components(60, 1), Path::Jump),
        ("debris", meshes::debris(150, 3), Path::Close),
        ("colours", meshes::colored_sphere(4), Path::Jump),
        ("noise", meshes::noisy_sphere(3000, 2), Path::Complete),
    ];
    let (mut sessions, mut batches, mut ops) = (0, 0, 0u64);
    for (name, mesh, path) in kinds {
        for placement in PlacementChoice::ALL {
            let what = format!("{name}, {placement:?}");
            let precision = if sessions % 2 == 0 { Precision::Visual } else { Precision::Exact };
            let options = BuildOptions { placement, precision, ..BuildOptions::default() };
            let test = TestModel::with_options(mesh.clone(), &options);
            let trace = SessionTrace::record(&test, path, UNLIMITED_TRIANGLES);
            ops += replay(&mut twin, &trace).with_context(|| what)?;
            sessions += 1;
            batches += trace.batches.len();
        }
    }
    println!("{sessions} sessions decode alike: {batches} batches, {ops} ops");
    Ok(())
}

/// Decodes a session at both ends.
fn replay(twin: &mut Twin, trace: &SessionTrace) -> Result<u64> {
    let mut state = trace.start();
    twin.push(&encode_base(&trace.base, trace.lattice_bits, trace.has_colors))?;
    let flags = [trace.has_colors, trace.has_moves].map(u32::from);
    let step = trace.visual_step.map_or(0, |step| step.get().into());
    let setup = (trace.lattice_bits.into(), flags[0], flags[1], step, trace.cache_entries);
    let digest = twin.base.call(&mut twin.store, setup)?;
    ensure!(digest == state.replica().digest(), "the bases differ");
    let mut ops = 0;
    for (i, batch) in trace.batches.iter().enumerate() {
        ops += u64::from(decode_batch(&batch.ops, &mut state, batch.limit)?.total());
        twin.push(&batch.ops)?;
        let digest = twin.batch.call(&mut twin.store, batch.limit).with_context(|| format!("batch {i}"))?;
        ensure!(digest == state.replica().digest(), "the meshes differ after batch {i}");
    }
    Ok(ops)
}
