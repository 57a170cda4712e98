//! The buffers equal the replica after each plan: on plain data, and on a GPU where there is one.

#![cfg(feature = "render")]

mod meshes;

use bytemuck::Zeroable;
use lodestream_client::render::buffers::MeshBuffers;
use lodestream_client::render::morph::GpuMorph;
use lodestream_client::render::readback::read_buffer;
use lodestream_client::render::upload::{
    self, Allowance, GpuVertex, UploadPlan, gpu_faces, gpu_vertices, planned_bytes,
};
use lodestream_client::render::{Gpu, GpuOptions, RenderError};
use lodestream_protocol::mesh::{Patch, Replica};
use lodestream_protocol::testing::{OperationRng, base_meshes};

/// The dull twin of the GPU buffers.
#[derive(Default)]
struct Plain {
    vertices: Vec<GpuVertex>,
    corners: Vec<[u32; 3]>,
}

impl Plain {
    fn capacity(&self) -> u32 {
        self.vertices.len() as u32
    }

    fn execute(&mut self, plan: &UploadPlan, replica: &Replica) {
        for ranges in [&plan.vertices, &plan.face_pairs] {
            let gap = upload::MERGED_GAP_SLOTS;
            assert!(ranges.windows(2).all(|w| w[0].end + gap <= w[1].start), "small gaps are merged: {ranges:?}");
        }
        self.copy(plan, replica);
    }

    fn copy(&mut self, plan: &UploadPlan, replica: &Replica) {
        if let Some(capacity) = plan.grow_to {
            assert!(capacity > self.capacity());
            self.vertices.resize(capacity as usize, GpuVertex::zeroed());
            self.corners.resize(2 * capacity as usize, [0; 3]);
        }
        for ranges in [&plan.vertices, &plan.face_pairs] {
            assert!(ranges.iter().all(|r| r.start < r.end && r.end <= plan.slot_end), "{ranges:?}");
        }
        for slots in &plan.vertices {
            for (slot, vertex) in slots.clone().zip(gpu_vertices(replica, slots.clone())) {
                self.vertices[slot as usize] = vertex;
            }
        }
        for slots in &plan.face_pairs {
            for (face, corners) in (2 * slots.start..).zip(gpu_faces(replica, slots.clone())) {
                self.corners[face as usize] = corners;
            }
        }
    }
}

/// Free vertex slots may hold anything, free face slots may not: they are drawn.
fn check_equal(vertices: &[GpuVertex], corners: &[[u32; 3]], replica: &Replica) {
    assert_eq!(corners[..2 * replica.slot_end() as usize], replica.corners().collect::<Vec<_>>());
    for slot in replica.vertices().iter() {
        let (position, [r, g, b]) = (replica.positions()[slot as usize], replica.colors()[slot as usize]);
        let expected = GpuVertex { position: position.map(|x| x as f32), color: u32::from_le_bytes([r, g, b, 255]) };
        assert_eq!(vertices[slot as usize], expected, "slot {slot}");
    }
}

fn random_ops(rng: &mut OperationRng, replica: &mut Replica) {
    let splits = [4, 60, 400][rng.below(3) as usize];
    for _ in 0..rng.below(splits) {
        rng.random_split(replica);
    }
    for _ in 0..rng.below(splits / 2) {
        rng.random_collapse(replica);
    }
}

#[test]
fn plans_keep_plain_buffers_equal_to_the_replica() {
    for seed in 0..40 {
        let mut rng = OperationRng::new(seed);
        let bases = base_meshes();
        let mut plain = Plain::default();
        // One set of buffers outlives three replicas, as it does when a session restarts. Some replicas track from the
        // start, others when they are first drawn.
        for _ in 0..3 {
            let (name, base) = &bases[rng.below(bases.len() as u32) as usize];
            let mut replica = Replica::new(base).unwrap();
            if rng.one_in(2) {
                replica.track_dirty();
            }
            for _ in 0..12 {
                random_ops(&mut rng, &mut replica);
                let plan = upload::plan(&mut replica, plain.capacity());
                plain.execute(&plan, &replica);
                check_equal(&plain.vertices, &plain.corners, &replica);
                assert!(upload::plan(&mut replica, plain.capacity()).is_empty(), "seed {seed}, {name}: planned twice");
            }
        }
    }
}

#[test]
fn small_changes_cost_little_and_growth_doubles() {
    let sphere = meshes::icosphere(4).replica(&meshes::lattice());
    let mut replica = sphere.clone();
    let plan = upload::plan(&mut replica, 0);
    assert_eq!((plan.grow_to, plan.slot_end), (Some(4096), replica.slot_end()));
    assert_eq!(plan.bytes(), u64::from(replica.slot_end()) * 40);
    OperationRng::new(1).random_split(&mut replica).unwrap();
    let plan = upload::plan(&mut replica, 4096);
    assert_eq!((plan.grow_to, plan.vertices.len()), (None, 1));
    assert!(plan.bytes() < 10_000, "{} bytes for one split", plan.bytes());
    assert_eq!(upload::plan(&mut sphere.clone(), 2048).grow_to, Some(4096));
}

#[test]
fn uploads_stay_within_the_allowance() {
    for seed in 0..10 {
        let mut rng = OperationRng::new(seed);
        let mut replica = meshes::icosphere(5).replica(&meshes::lattice());
        upload::plan(&mut replica, 0);
        let mut allowance = Allowance::new(200_000);
        let (mut images, mut batches, mut fullest) = (0, 0, 0);
        // Batches wait, of ops of three bytes anywhere on the mesh: the worst there is for merging. None of them alone is
        // too much.
        let mut waiting: Vec<u32> = (0..300).map(|_| 1 + rng.below(40)).collect();
        while let Some(&ops) = waiting.last() {
            let planned = planned_bytes(&mut replica).expect("it tracks");
            let op_bytes = 3 * ops as usize;
            if allowance.admits(planned, op_bytes) {
                waiting.pop();
                batches += 1;
                for _ in 0..ops {
                    match rng.one_in(3) {
                        true => rng.random_collapse(&mut replica),
                        false => rng.random_split(&mut replica),
                    };
                }
                let after = planned_bytes(&mut replica).expect("it tracks");
                allowance.learn(planned, after, op_bytes);
                continue;
            }
            let slots = replica.slot_end();
            let plan = upload::plan(&mut replica, slots);
            let touched: u32 = plan.vertices.iter().map(|range| range.end - range.start).sum();
            let states = u64::from(touched) * size_of::<GpuMorph>() as u64;
            assert_eq!(
                plan.bytes() + states,
                planned,
                "what was foreseen is what is written, and a state for each vertex"
            );
            assert!(planned <= 200_000, "seed {seed}: image {images} uploads {planned}");
            images += 1;
            fullest = fullest.max(planned);
        }
        // It is used, not just kept.
        assert!(fullest > 100_000 && batches == 300 && images < 150, "{fullest} bytes, {images} images");
    }
}

#[test]
fn ops_all_over_a_large_mesh_write_little_between_them() {
    let mut replica = meshes::icosphere(7).replica(&meshes::lattice());
    let mut plain = Plain::default();
    plain.execute(&upload::plan(&mut replica, 0), &replica);
    let mut rng = OperationRng::new(3);
    for _ in 0..4000 {
        rng.random_split(&mut replica);
    }
    let wide = planned_bytes(&mut replica).expect("it tracks");
    let plan = upload::plan(&mut replica, plain.capacity());
    assert!(wide > 2 * upload::WIDE_BYTES && plan.bytes() <= upload::WIDE_BYTES, "{wide}, then {}", plan.bytes());
    for ranges in [&plan.vertices, &plan.face_pairs] {
        assert!(ranges.windows(2).all(|w| w[0].end < w[1].start), "ascending and apart");
    }
    plain.copy(&plan, &replica);
    check_equal(&plain.vertices, &plain.corners, &replica);
}

#[test]
fn a_single_batch_passes_whatever_it_costs() {
    let mut allowance = Allowance::new(10);
    assert!(allowance.admits(0, 1_000_000) && !allowance.admits(1, 1));
    allowance.learn(0, 5_000_000, 1000);
    assert!(allowance.admits(0, 1_000_000) && allowance.estimate(10) >= 50_000);
    // Costly batches are forgotten.
    (0..300).for_each(|_| allowance.learn(0, 1000, 1000));
    assert!(allowance.estimate(10) < 200);
}

#[test]
fn gpu_buffers_equal_the_replica() -> Result<(), RenderError> {
    let gpu = match Gpu::offscreen(&GpuOptions::from_env()) {
        Ok(gpu) => gpu,
        Err(RenderError::NoAdapter) => {
            eprintln!("skipped: no graphics adapter");
            return Ok(());
        }
        Err(e) => return Err(e),
    };
    let mut rng = OperationRng::new(7);
    let mut buffers = MeshBuffers::new(&gpu.device);
    let large = meshes::icosphere(5).replica(&meshes::lattice());
    let replicas = [Replica::new(&base_meshes()[3].1).unwrap(), large, Replica::new(&Patch::default()).unwrap()];
    for mut replica in replicas {
        for _ in 0..4 {
            random_ops(&mut rng, &mut replica);
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            buffers.update(&gpu.device, &mut encoder, &mut replica)?;
            gpu.queue.submit([encoder.finish()]);
            let vertices = read_buffer(&gpu.device, &gpu.queue, buffers.vertices())?;
            let indices = read_buffer(&gpu.device, &gpu.queue, buffers.indices())?;
            assert_eq!(buffers.slot_end(), replica.slot_end());
            check_equal(bytemuck::cast_slice(&vertices), bytemuck::cast_slice(&indices), &replica);
        }
    }
    Ok(())
}
