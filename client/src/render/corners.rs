//! Buffers for drawing by corner, and the passes that compute the corners' normals.

use wgpu::{BindGroup, Buffer, BufferUsages, CommandEncoder, Device};

use super::buffers::MeshBuffers;
use super::pipeline::{CornerPipelines, WORKGROUP};

/// Bytes per slot of the buffers besides the mesh: links, face normals, corner normals.
const LINK_BYTES: u64 = 4 + 24;
const FACE_NORMAL_BYTES: u64 = 32;
const CORNER_NORMAL_BYTES: u64 = 24;

/// What drawing by corner needs besides the mesh, for as many slots as the mesh buffers hold.
#[derive(Debug)]
pub(super) struct CornerBuffers {
    links: Buffer,
    corner_normals: Buffer,
    capacity_slots: u32,
    link_group: BindGroup,
    corners_group: BindGroup,
    /// Group 1 of drawing.
    pub(super) draw_group: BindGroup,
    /// Of the normals, `None` if they were not computed for the mesh as it is.
    pub(super) computed_crease: Option<f32>,
}

impl CornerBuffers {
    /// Whether buffers of this size can be bound.
    pub(super) fn fit(device: &Device, capacity_slots: u32) -> bool {
        let limits = device.limits();
        let largest = limits.max_buffer_size.min(limits.max_storage_buffer_binding_size);
        u64::from(capacity_slots) * FACE_NORMAL_BYTES <= largest
    }

    pub(super) fn new(device: &Device, pipelines: &CornerPipelines, mesh: &MeshBuffers) -> Self {
        let capacity_slots = mesh.capacity_slots();
        let buffer = |label, bytes: u64| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: Some(label),
                size: u64::from(capacity_slots) * bytes,
                usage: BufferUsages::STORAGE | BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        };
        let links = buffer("links", LINK_BYTES);
        let face_normals = buffer("face normals", FACE_NORMAL_BYTES);
        let corner_normals = buffer("corner normals", CORNER_NORMAL_BYTES);
        let (vertices, indices) = (mesh.vertices(), mesh.indices());
        let group = |layout, bindings: &[(u32, &Buffer)]| {
            let entries: Vec<_> = bindings
                .iter()
                .map(|&(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
                .collect();
            device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout, entries: &entries })
        };
        let link_bindings = [(0, vertices), (1, indices), (2, &links), (3, &face_normals)];
        let corner_bindings = [(1, indices), (2, &links), (3, &face_normals), (4, &corner_normals)];
        let draw_bindings = [(0, vertices), (1, indices), (2, &corner_normals)];
        Self {
            link_group: group(&pipelines.link_layout, &link_bindings),
            corners_group: group(&pipelines.corners_layout, &corner_bindings),
            draw_group: group(&pipelines.draw_layout, &draw_bindings),
            links,
            corner_normals,
            capacity_slots,
            computed_crease: None,
        }
    }

    /// Whether these belong to the mesh buffers as they are.
    pub(super) fn are_of(&self, mesh: &MeshBuffers) -> bool {
        self.capacity_slots == mesh.capacity_slots()
    }

    /// Records the computation of all corner normals. Group 0 is `globals`.
    pub(super) fn compute_normals(
        &self,
        device: &Device,
        encoder: &mut CommandEncoder,
        pipelines: &CornerPipelines,
        globals: &BindGroup,
        slots: u32,
    ) {
        if slots == 0 {
            return;
        }
        encoder.clear_buffer(&self.links, 0, Some(u64::from(slots) * 4));
        encoder.clear_buffer(&self.corner_normals, 0, Some(u64::from(slots) * CORNER_NORMAL_BYTES));
        let mut pass =
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("normals"), timestamp_writes: None });
        pass.set_bind_group(0, globals, &[]);
        let most_x = device.limits().max_compute_workgroups_per_dimension;
        let mut dispatch = |pipeline, group, elements: u32| {
            let groups = elements.div_ceil(WORKGROUP);
            let x = groups.min(most_x);
            pass.set_pipeline(pipeline);
            pass.set_bind_group(1, group, &[]);
            pass.dispatch_workgroups(x, groups.div_ceil(x), 1);
        };
        dispatch(&pipelines.link, &self.link_group, 2 * slots);
        dispatch(&pipelines.corners, &self.corners_group, slots);
    }
}
