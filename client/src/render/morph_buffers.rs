//! The states of transitions on the GPU, and the vertices as they are shown.
//!
//! While something moves, a compute pass writes all vertices to a buffer of their own, which drawing and normals read instead
//! of the mesh's. When nothing moves, that buffer is not read, so the image is exactly what it is without transitions.

use std::ops::Range;

use wgpu::{BindGroup, BindGroupLayout, Buffer, BufferUsages, CommandEncoder, Device, Queue};

use super::buffers::MeshBuffers;
use super::morph::{GpuMorph, Morphs};
use super::pipeline::{MORPH_SHADER, bind, compute_layout, dispatch, shader};
use super::upload::{VERTEX_BYTES, WIDE_STATE_BYTES, narrowed};

const STATE_BYTES: u64 = size_of::<GpuMorph>() as u64;

/// What depends on the device alone.
#[derive(Debug)]
pub(super) struct MorphPipeline {
    layout: BindGroupLayout,
    show: wgpu::ComputePipeline,
}

/// Buffers for as many slots as the mesh buffers hold.
#[derive(Debug)]
pub(super) struct MorphBuffers {
    states: Buffer,
    shown: Buffer,
    group: BindGroup,
    capacity_slots: u32,
}

impl MorphPipeline {
    pub(super) fn new(device: &Device, globals: &BindGroupLayout) -> Self {
        let read = wgpu::BufferBindingType::Storage { read_only: true };
        let write = wgpu::BufferBindingType::Storage { read_only: false };
        let layout = compute_layout(device, "morph", &[(0, read), (1, read), (2, write)]);
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("morph"),
            bind_group_layouts: &[Some(globals), Some(&layout)],
            immediate_size: 0,
        });
        let show = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some("morph"),
            layout: Some(&pipeline_layout),
            module: &shader(device, "morph", MORPH_SHADER),
            entry_point: Some("show"),
            compilation_options: Default::default(),
            cache: None,
        });
        Self { layout, show }
    }
}

impl MorphBuffers {
    /// States of vertices in their places.
    pub(super) fn new(device: &Device, pipeline: &MorphPipeline, mesh: &MeshBuffers) -> Self {
        let capacity_slots = mesh.capacity_slots();
        let buffer = |label, bytes: u64, usage| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: u64::from(capacity_slots) * bytes,
                usage: BufferUsages::STORAGE | usage,
                mapped_at_creation: false,
            })
        };
        let states = buffer("morph states", STATE_BYTES, BufferUsages::COPY_DST);
        let shown = buffer("shown vertices", VERTEX_BYTES, BufferUsages::VERTEX);
        let group = bind(device, &pipeline.layout, &[(0, mesh.vertices()), (1, &states), (2, &shown)]);
        Self { states, shown, group, capacity_slots }
    }

    /// Whether these belong to the mesh buffers as they are.
    pub(super) fn are_of(&self, mesh: &MeshBuffers) -> bool {
        self.capacity_slots == mesh.capacity_slots()
    }

    /// The vertices as they are shown.
    pub(super) fn shown(&self) -> &Buffer {
        &self.shown
    }

    /// Writes the states of these slots (ascending) and returns how many bytes that took.
    pub(super) fn write(&self, queue: &Queue, morphs: &Morphs, slots: &[u32]) -> u64 {
        let mut bytes = 0;
        let ranges = narrowed(WIDE_STATE_BYTES, |gap| {
            let ranges = merged(slots, morphs.len(), gap);
            let bytes = ranges.iter().map(|range| u64::from(range.end - range.start) * STATE_BYTES).sum();
            (ranges, bytes)
        });
        for range in ranges {
            let states: Vec<GpuMorph> = range.clone().map(|slot| morphs.state(slot)).collect();
            let data: &[u8] = bytemuck::cast_slice(&states);
            queue.write_buffer(&self.states, u64::from(range.start) * STATE_BYTES, data);
            bytes += data.len() as u64;
        }
        bytes
    }

    /// Records the pass that says where all vertices are shown.
    pub(super) fn encode(
        &self,
        device: &Device,
        encoder: &mut CommandEncoder,
        pipeline: &MorphPipeline,
        globals: &BindGroup,
        slots: u32,
    ) {
        if slots == 0 {
            return;
        }
        let mut pass =
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("morph"), timestamp_writes: None });
        pass.set_bind_group(0, globals, &[]);
        dispatch(device, &mut pass, &pipeline.show, &self.group, slots);
    }
}

/// Slots as intervals, with gaps of fewer than `gap` slots closed: a write costs more than the states in one.
fn merged(slots: &[u32], end: u32, gap: u32) -> Vec<Range<u32>> {
    let mut ranges: Vec<Range<u32>> = Vec::new();
    for &slot in slots.iter().filter(|&&slot| slot < end) {
        match ranges.last_mut() {
            Some(last) if slot - last.end < gap => last.end = slot + 1,
            _ => ranges.push(slot..slot + 1),
        }
    }
    ranges
}
