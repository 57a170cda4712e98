//! The mesh in GPU buffers whose element numbers are replica slots: executes [`UploadPlan`]s.

use std::ops::Range;

use lodestream_protocol::mesh::Replica;
use wgpu::util::DeviceExt;
use wgpu::{Buffer, BufferUsages, CommandEncoder, Device};

use super::error::RenderError;
use super::pipeline::has_storage;
use super::upload::{self, FACE_PAIR_BYTES, UploadPlan, VERTEX_BYTES, gpu_faces, gpu_vertices};

/// Most bytes staged in one buffer.
const STAGING_BYTES: usize = 16 << 20;

/// Vertex and index buffer of one mesh.
#[derive(Debug)]
pub struct MeshBuffers {
    vertices: Buffer,
    /// Also read as storage where the shader needs to know the corner and not just the vertex.
    indices: Buffer,
    capacity_slots: u32,
    limit_slots: u32,
    slot_end: u32,
    /// Kept for its memory.
    scratch: Vec<u8>,
}

/// Copies from one staging buffer: (destination, offset, length).
type Copies = Vec<(Target, u64, u64)>;

#[derive(Clone, Copy, PartialEq, Eq)]
enum Target {
    Vertices,
    Indices,
}

impl MeshBuffers {
    /// Empty buffers.
    pub fn new(device: &Device) -> Self {
        let limit = device.limits().max_buffer_size / FACE_PAIR_BYTES;
        Self {
            vertices: vertex_buffer(device, 1),
            indices: index_buffer(device, 1),
            capacity_slots: 1,
            limit_slots: u32::try_from(limit).unwrap_or(u32::MAX),
            slot_end: 0,
            scratch: Vec::new(),
        }
    }

    /// One [`GpuVertex`](upload::GpuVertex) per slot.
    pub fn vertices(&self) -> &Buffer {
        &self.vertices
    }

    /// Six `u32` per slot: the corners of face slots `2v` and `2v + 1`.
    pub fn indices(&self) -> &Buffer {
        &self.indices
    }

    /// Slots that fit without growing.
    pub fn capacity_slots(&self) -> u32 {
        self.capacity_slots
    }

    /// One past the last slot to draw.
    pub fn slot_end(&self) -> u32 {
        self.slot_end
    }

    /// Records the copies that make the buffers equal `replica` once `encoder` is submitted, clears the replica's dirty
    /// record and returns what was planned.
    ///
    /// # Errors
    /// [`RenderError::MeshTooLarge`]; the record and the buffers are as before then.
    pub fn update(
        &mut self,
        device: &Device,
        encoder: &mut CommandEncoder,
        replica: &mut Replica,
    ) -> Result<UploadPlan, RenderError> {
        let slots = replica.slot_end();
        if slots > self.limit_slots {
            return Err(RenderError::MeshTooLarge { slots, limit: self.limit_slots });
        }
        let plan = upload::plan(replica, self.capacity_slots);
        if let Some(capacity) = plan.grow_to {
            self.grow(device, encoder, capacity.min(self.limit_slots));
        }
        self.slot_end = plan.slot_end;
        self.write(device, encoder, replica, &plan);
        Ok(plan)
    }

    fn grow(&mut self, device: &Device, encoder: &mut CommandEncoder, capacity: u32) {
        let (vertices, indices) = (vertex_buffer(device, capacity), index_buffer(device, capacity));
        let held = u64::from(self.slot_end);
        if held > 0 {
            encoder.copy_buffer_to_buffer(&self.vertices, 0, &vertices, 0, held * VERTEX_BYTES);
            encoder.copy_buffer_to_buffer(&self.indices, 0, &indices, 0, held * FACE_PAIR_BYTES);
        }
        self.vertices = vertices;
        self.indices = indices;
        self.capacity_slots = capacity;
    }

    /// One staging buffer for many intervals: a write of its own for each would allocate one each.
    fn write(&mut self, device: &Device, encoder: &mut CommandEncoder, replica: &Replica, plan: &UploadPlan) {
        let mut copies = Copies::new();
        let mut stage = std::mem::take(&mut self.scratch);
        stage.clear();
        let pieces = pieces(&plan.vertices, VERTEX_BYTES)
            .map(|r| (Target::Vertices, r))
            .chain(pieces(&plan.face_pairs, FACE_PAIR_BYTES).map(|r| (Target::Indices, r)));
        for (target, slots) in pieces {
            let begin = stage.len();
            let element_bytes = match target {
                Target::Vertices => {
                    gpu_vertices(replica, slots.clone()).for_each(|v| stage.extend_from_slice(bytemuck::bytes_of(&v)));
                    VERTEX_BYTES
                }
                Target::Indices => {
                    gpu_faces(replica, slots.clone()).for_each(|f| stage.extend_from_slice(bytemuck::bytes_of(&f)));
                    FACE_PAIR_BYTES
                }
            };
            copies.push((target, u64::from(slots.start) * element_bytes, (stage.len() - begin) as u64));
            if stage.len() >= STAGING_BYTES {
                self.flush(device, encoder, &mut stage, &mut copies);
            }
        }
        self.flush(device, encoder, &mut stage, &mut copies);
        self.scratch = stage;
    }

    fn flush(&self, device: &Device, encoder: &mut CommandEncoder, stage: &mut Vec<u8>, copies: &mut Copies) {
        if stage.is_empty() {
            return;
        }
        let staging = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("mesh staging"),
            contents: stage,
            // Mappable memory is filled in place. WebGL needs it: it copies from no other kind of buffer to one of indices.
            usage: BufferUsages::COPY_SRC | BufferUsages::MAP_WRITE,
        });
        let mut from = 0;
        for (target, offset, length) in copies.drain(..) {
            let to = match target {
                Target::Vertices => &self.vertices,
                Target::Indices => &self.indices,
            };
            encoder.copy_buffer_to_buffer(&staging, from, to, offset, length);
            from += length;
        }
        stage.clear();
    }
}

/// The ranges cut so that no piece has more bytes than a staging buffer should.
fn pieces(ranges: &[Range<u32>], element_bytes: u64) -> impl Iterator<Item = Range<u32>> + '_ {
    let most = STAGING_BYTES / element_bytes as usize;
    ranges.iter().flat_map(move |range| {
        range.clone().step_by(most).map(move |start| start..range.end.min(start.saturating_add(most as u32)))
    })
}

/// WebGL allows an index buffer no use besides, and has no storage buffers.
fn shared_usage(device: &Device) -> BufferUsages {
    let storage = if has_storage(&device.limits()) { BufferUsages::STORAGE } else { BufferUsages::empty() };
    storage | BufferUsages::COPY_DST | BufferUsages::COPY_SRC
}

fn vertex_buffer(device: &Device, slots: u32) -> Buffer {
    device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("mesh vertices"),
        size: u64::from(slots) * VERTEX_BYTES,
        usage: BufferUsages::VERTEX | shared_usage(device),
        mapped_at_creation: false,
    })
}

fn index_buffer(device: &Device, slots: u32) -> Buffer {
    device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("mesh faces"),
        size: u64::from(slots) * FACE_PAIR_BYTES,
        usage: BufferUsages::INDEX | shared_usage(device),
        mapped_at_creation: false,
    })
}
