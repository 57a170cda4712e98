//! Buffers for drawing by corner, and the passes that compute the corners' normals.

use wgpu::{BindGroup, Buffer, BufferUsages, CommandEncoder, Device};

use super::buffers::MeshBuffers;
use super::pipeline::{CornerPipelines, bind, dispatch};

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
    draw_group: BindGroup,
    /// While something moves.
    moving: Option<Moving>,
    /// Of the normals, `None` if they were not computed for the mesh as it is.
    pub(super) computed_crease: Option<f32>,
}

/// Normals as they are shown while they follow those that were computed.
#[derive(Debug)]
struct Moving {
    shown_normals: Buffer,
    follow_group: BindGroup,
    draw_group: BindGroup,
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
        let buffer = |label, bytes| corner_buffer(device, label, u64::from(capacity_slots) * bytes);
        let links = buffer("links", LINK_BYTES);
        let face_normals = buffer("face normals", FACE_NORMAL_BYTES);
        let corner_normals = buffer("corner normals", CORNER_NORMAL_BYTES);
        let (vertices, indices) = (mesh.vertices(), mesh.indices());
        let link_bindings = [(0, vertices), (1, indices), (2, &links), (3, &face_normals)];
        let corner_bindings = [(1, indices), (2, &links), (3, &face_normals), (4, &corner_normals)];
        let draw_bindings = [(0, vertices), (1, indices), (2, &corner_normals)];
        Self {
            link_group: bind(device, &pipelines.link_layout, &link_bindings),
            corners_group: bind(device, &pipelines.corners_layout, &corner_bindings),
            draw_group: bind(device, &pipelines.draw_layout, &draw_bindings),
            moving: None,
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

    /// Vertices are read from `shown` from now on, and normals begin where they were in the last image: those of `last`, whose
    /// buffers have become too small, or the own ones. Recorded before they are computed for the mesh as it is now.
    pub(super) fn begin_to_move(
        &mut self,
        device: &Device,
        encoder: &mut CommandEncoder,
        pipelines: &CornerPipelines,
        mesh: &MeshBuffers,
        shown: &Buffer,
        last: Option<&Self>,
    ) {
        let last = last.unwrap_or(self);
        let bytes = u64::from(self.capacity_slots) * CORNER_NORMAL_BYTES;
        let shown_normals = corner_buffer(device, "shown normals", bytes);
        let normals = last.moving.as_ref().map_or(&last.corner_normals, |moving| &moving.shown_normals);
        encoder.copy_buffer_to_buffer(normals, 0, &shown_normals, 0, normals.size().min(bytes));
        let follow_bindings = [(0, &self.corner_normals), (1, &shown_normals)];
        let draw_bindings = [(0, shown), (1, mesh.indices()), (2, &shown_normals)];
        self.moving = Some(Moving {
            follow_group: bind(device, &pipelines.follow_layout, &follow_bindings),
            draw_group: bind(device, &pipelines.draw_layout, &draw_bindings),
            shown_normals,
        });
    }

    /// Vertices are read from the mesh from now on, and normals as they were computed.
    pub(super) fn stop_moving(&mut self) {
        self.moving = None;
    }

    /// Whether vertices are read from elsewhere.
    pub(super) fn is_moving(&self) -> bool {
        self.moving.is_some()
    }

    /// Group 1 of drawing.
    pub(super) fn draw_group(&self) -> &BindGroup {
        self.moving.as_ref().map_or(&self.draw_group, |moving| &moving.draw_group)
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
        dispatch(device, &mut pass, &pipelines.link, &self.link_group, 2 * slots);
        dispatch(device, &mut pass, &pipelines.corners, &self.corners_group, slots);
    }

    /// Records that the normals that are shown follow, if they are others than those that were computed.
    pub(super) fn follow(
        &self,
        device: &Device,
        encoder: &mut CommandEncoder,
        pipelines: &CornerPipelines,
        globals: &BindGroup,
        slots: u32,
    ) {
        let Some(moving) = &self.moving else { return };
        let mut pass =
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("follow"), timestamp_writes: None });
        pass.set_bind_group(0, globals, &[]);
        dispatch(device, &mut pass, &pipelines.follow, &moving.follow_group, 6 * slots);
    }
}

fn corner_buffer(device: &Device, label: &str, bytes: u64) -> Buffer {
    device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(label),
        size: bytes,
        usage: BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    })
}
