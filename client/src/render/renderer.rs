//! One image of a replica: upload what changed, compute normals, draw.

use lodestream_protocol::mesh::Replica;
use lodestream_protocol::quant::Lattice;
use wgpu::{BindGroup, Buffer, BufferUsages, CommandEncoder, Device, Queue, TextureFormat, TextureView};

use super::buffers::MeshBuffers;
use super::camera::{CameraUniform, RenderCamera};
use super::error::RenderError;
use super::options::{CLAY_LINEAR, RenderOptions, Shading, srgb_decode};
use super::pipeline::{DEPTH_FORMAT, Globals, Pipelines, SAMPLES, SmoothPipelines, WORKGROUP};

/// Bytes per slot of the buffers that smooth shading needs besides the mesh: links, face normals, corner normals.
const LINK_BYTES: u64 = 4 + 24;
const FACE_NORMAL_BYTES: u64 = 32;
const CORNER_NORMAL_BYTES: u64 = 24;

/// Draws one replica to targets of one format.
///
/// Follows the replica by its dirty record, which it clears. A record belongs to one follower: whoever has two renderers,
/// or hands a renderer a replica that another one has drawn, calls [`Replica::track_dirty`] first, after which everything
/// counts as touched. A replica made anew (after a restart) needs no more than that it tracks, or does not track yet.
#[derive(Debug)]
pub struct Renderer {
    device: Device,
    queue: Queue,
    format: TextureFormat,
    pipelines: Pipelines,
    mesh: MeshBuffers,
    globals: Buffer,
    globals_group: BindGroup,
    smooth: Option<SmoothBuffers>,
    /// Of the normals in `smooth`, `None` if the mesh has changed since.
    computed_crease: Option<f32>,
    target: Option<TargetBuffers>,
}

/// What an image cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DrawStats {
    /// Bytes written to the mesh buffers.
    pub uploaded_bytes: u64,
    /// Whether normals were computed.
    pub computed_normals: bool,
    /// Whether smooth shading was asked for and possible.
    pub is_smooth: bool,
}

/// Multisampled colour and depth of the current size.
#[derive(Debug)]
struct TargetBuffers {
    width: u32,
    height: u32,
    color: TextureView,
    depth: TextureView,
}

/// What smooth shading needs besides the mesh, for as many slots as the mesh buffers hold.
#[derive(Debug)]
struct SmoothBuffers {
    links: Buffer,
    corner_normals: Buffer,
    capacity_slots: u32,
    link_group: BindGroup,
    corners_group: BindGroup,
    draw_group: BindGroup,
}

impl Renderer {
    /// Compiles the pipelines. `format` is that of the targets; one with `Srgb` blends edges in linear light.
    pub fn new(device: &Device, queue: &Queue, format: TextureFormat) -> Self {
        let pipelines = Pipelines::new(device, format);
        let globals = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("globals"),
            size: size_of::<Globals>() as u64,
            usage: BufferUsages::UNIFORM | BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let globals_group = device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some("globals"),
            layout: &pipelines.globals,
            entries: &[wgpu::BindGroupEntry { binding: 0, resource: globals.as_entire_binding() }],
        });
        Self {
            device: device.clone(),
            queue: queue.clone(),
            format,
            pipelines,
            mesh: MeshBuffers::new(device),
            globals,
            globals_group,
            smooth: None,
            computed_crease: None,
            target: None,
        }
    }

    /// The mesh as the GPU has it.
    pub fn mesh(&self) -> &MeshBuffers {
        &self.mesh
    }

    /// Makes room for targets of this size in pixels. Does nothing if it has not changed.
    ///
    /// # Errors
    /// [`RenderError::ImageSize`].
    pub fn resize(&mut self, width: u32, height: u32) -> Result<(), RenderError> {
        if self.target.as_ref().is_some_and(|t| (t.width, t.height) == (width, height)) {
            return Ok(());
        }
        check_size(&self.device, width, height)?;
        let view = |label, format| {
            let texture = self.device.create_texture(&wgpu::TextureDescriptor {
                label: Some(label),
                size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: SAMPLES,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
                view_formats: &[],
            });
            texture.create_view(&Default::default())
        };
        // The old ones go first: both may not fit at once.
        self.target = None;
        self.target = Some(TargetBuffers {
            width,
            height,
            color: view("color", self.format),
            depth: view("depth", DEPTH_FORMAT),
        });
        Ok(())
    }

    /// Uploads what changed, draws the replica to `target`, which has the size of the last [`resize`](Self::resize), and
    /// submits. The buffers equal the replica then.
    ///
    /// # Errors
    /// [`RenderError::MeshTooLarge`]; nothing is drawn then.
    ///
    /// # Panics
    /// Without a [`resize`](Self::resize) before.
    pub fn draw(
        &mut self,
        target: &TextureView,
        replica: &mut Replica,
        lattice: &Lattice,
        camera: &RenderCamera,
        options: &RenderOptions,
    ) -> Result<DrawStats, RenderError> {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("image") });
        let plan = self.mesh.update(&self.device, &mut encoder, replica)?;
        let size = self.target.as_ref().expect("resize comes before draw");
        let aspect = f64::from(size.width) / f64::from(size.height);
        let camera = CameraUniform::new(camera, lattice, aspect);
        let crease = options.crease_angle_deg.clamp(0.0, 180.0);
        self.write_globals(camera, options.vertex_colors, crease);
        if !plan.is_empty() || plan.grow_to.is_some() {
            self.computed_crease = None;
        }
        let is_smooth = options.shading == Shading::Smooth && self.prepare_smooth();
        let computed_normals = is_smooth && self.computed_crease != Some(crease);
        if computed_normals {
            self.compute_normals(&mut encoder);
            self.computed_crease = Some(crease);
        }
        self.encode_pass(&mut encoder, target, is_smooth, options.background);
        self.queue.submit([encoder.finish()]);
        Ok(DrawStats { uploaded_bytes: plan.bytes(), computed_normals, is_smooth })
    }

    fn write_globals(&self, camera: CameraUniform, vertex_colors: bool, crease_angle_deg: f32) {
        let [r, g, b] = CLAY_LINEAR;
        let globals = Globals {
            camera,
            base_color: [r, g, b, if vertex_colors { 1.0 } else { 0.0 }],
            slot_end: self.mesh.slot_end(),
            capacity_slots: self.mesh.capacity_slots(),
            crease_cosine: crease_angle_deg.to_radians().cos(),
            unused: 0,
        };
        self.queue.write_buffer(&self.globals, 0, bytemuck::bytes_of(&globals));
    }

    /// Makes the buffers for smooth shading as large as the mesh's. False where the device cannot.
    fn prepare_smooth(&mut self) -> bool {
        let Some(pipelines) = &self.pipelines.smooth else { return false };
        let capacity = self.mesh.capacity_slots();
        let limits = self.device.limits();
        let largest = limits.max_buffer_size.min(limits.max_storage_buffer_binding_size);
        if u64::from(capacity) * FACE_NORMAL_BYTES > largest {
            self.smooth = None;
            return false;
        }
        if self.smooth.as_ref().is_none_or(|s| s.capacity_slots != capacity) {
            self.smooth = None;
            self.smooth = Some(SmoothBuffers::new(&self.device, pipelines, &self.mesh));
            self.computed_crease = None;
        }
        true
    }

    fn compute_normals(&self, encoder: &mut CommandEncoder) {
        let (Some(pipelines), Some(buffers)) = (&self.pipelines.smooth, &self.smooth) else { return };
        let slots = self.mesh.slot_end();
        if slots == 0 {
            return;
        }
        encoder.clear_buffer(&buffers.links, 0, Some(u64::from(slots) * 4));
        encoder.clear_buffer(&buffers.corner_normals, 0, Some(u64::from(slots) * CORNER_NORMAL_BYTES));
        let mut pass =
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some("normals"), timestamp_writes: None });
        pass.set_bind_group(0, &self.globals_group, &[]);
        let most_x = self.device.limits().max_compute_workgroups_per_dimension;
        let mut dispatch = |pipeline, group, elements: u32| {
            let groups = elements.div_ceil(WORKGROUP);
            let x = groups.min(most_x);
            pass.set_pipeline(pipeline);
            pass.set_bind_group(1, group, &[]);
            pass.dispatch_workgroups(x, groups.div_ceil(x), 1);
        };
        dispatch(&pipelines.link, &buffers.link_group, 2 * slots);
        dispatch(&pipelines.corners, &buffers.corners_group, slots);
    }

    fn encode_pass(&self, encoder: &mut CommandEncoder, target: &TextureView, is_smooth: bool, background: [u8; 3]) {
        let buffers = self.target.as_ref().expect("resize comes before draw");
        let component = |byte: u8| if self.format.is_srgb() { srgb_decode(byte) } else { f64::from(byte) / 255.0 };
        let [r, g, b] = background.map(component);
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("mesh"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &buffers.color,
                depth_slice: None,
                resolve_target: Some(target),
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color { r, g, b, a: 1.0 }),
                    store: wgpu::StoreOp::Discard,
                },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &buffers.depth,
                depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard }),
                stencil_ops: None,
            }),
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        let corners = 6 * self.mesh.slot_end();
        if corners == 0 {
            return;
        }
        pass.set_bind_group(0, &self.globals_group, &[]);
        match (&self.pipelines.smooth, &self.smooth) {
            (Some(pipelines), Some(smooth)) if is_smooth => {
                pass.set_pipeline(&pipelines.draw);
                pass.set_bind_group(1, &smooth.draw_group, &[]);
                pass.draw(0..corners, 0..1);
            }
            _ => {
                pass.set_pipeline(&self.pipelines.flat);
                pass.set_vertex_buffer(0, self.mesh.vertices().slice(..));
                pass.set_index_buffer(self.mesh.indices().slice(..), wgpu::IndexFormat::Uint32);
                pass.draw_indexed(0..corners, 0, 0..1);
            }
        }
    }
}

impl SmoothBuffers {
    fn new(device: &Device, pipelines: &SmoothPipelines, mesh: &MeshBuffers) -> Self {
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
        }
    }
}

/// Whether the device has textures of this size.
pub(super) fn check_size(device: &Device, width: u32, height: u32) -> Result<(), RenderError> {
    let limit = device.limits().max_texture_dimension_2d;
    if (1..=limit).contains(&width) && (1..=limit).contains(&height) {
        return Ok(());
    }
    Err(RenderError::ImageSize { width, height, limit })
}
