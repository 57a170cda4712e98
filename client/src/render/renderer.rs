//! One image of a replica: upload what changed, compute normals, draw.

use lodestream_protocol::mesh::Replica;
use lodestream_protocol::quant::Lattice;
use wgpu::util::DeviceExt;
use wgpu::{BindGroup, Buffer, BufferUsages, CommandEncoder, Device, Queue, TextureFormat, TextureView};

use super::buffers::MeshBuffers;
use super::camera::{CameraUniform, RenderCamera};
use super::corners::CornerBuffers;
use super::error::RenderError;
use super::globals::{Globals, encode};
use super::lines::{Line, gpu_lines};
use super::options::{RenderOptions, Shading};
use super::pipeline::{Geometry, MeshPipeline, Pipelines};
use super::target::Canvas;

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
    corners: Option<CornerBuffers>,
    canvas: Option<Canvas>,
    lines: Vec<Line>,
}

/// What an image cost, and which of its options this device could not do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DrawStats {
    /// Bytes written to the mesh buffers.
    pub uploaded_bytes: u64,
    /// Whether normals were computed.
    pub computed_normals: bool,
    /// Whether smooth shading was asked for and possible.
    pub is_smooth: bool,
    /// Whether wireframe, refinement colours or tinted backs were asked for and possible.
    pub has_details: bool,
}

/// What belongs to one image and goes from step to step.
struct Image<'a> {
    target: &'a TextureView,
    options: &'a RenderOptions,
    pipeline: MeshPipeline,
    /// Instances of lines and their number: first all that are hidden, then all that are seen.
    lines: Option<(Buffer, u32)>,
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
            corners: None,
            canvas: None,
            lines: Vec::new(),
        }
    }

    /// The mesh as the GPU has it.
    pub fn mesh(&self) -> &MeshBuffers {
        &self.mesh
    }

    /// Lines that are drawn on top of every image from now on: at most [`MAX_LINES`](super::lines::MAX_LINES).
    pub fn set_lines(&mut self, lines: &[Line]) {
        self.lines.clear();
        self.lines.extend_from_slice(lines);
    }

    /// Makes room for targets of this size in pixels. Does nothing if it has not changed.
    ///
    /// # Errors
    /// [`RenderError::ImageSize`].
    pub fn resize(&mut self, width: u32, height: u32) -> Result<(), RenderError> {
        let size = [width, height];
        if self.canvas.as_ref().is_some_and(|canvas| canvas.size == size) {
            return Ok(());
        }
        // The old one goes first: both may not fit at once.
        self.canvas = None;
        self.canvas = Some(Canvas::new(&self.device, self.format, size, false)?);
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
        if let Some(corners) = &mut self.corners
            && !plan.is_empty()
        {
            corners.computed_crease = None;
        }
        let size = self.canvas.as_ref().expect("resize comes before draw").size;
        let aspect = f64::from(size[0]) / f64::from(size[1]);
        let camera = CameraUniform::new(camera, lattice, aspect, options.light_direction());
        self.write_globals(Globals::new(camera, lattice, options, size, self.format));

        let by_corner = (options.shading == Shading::Smooth || options.has_details()) && self.prepare_corners();
        let is_smooth = by_corner && options.shading == Shading::Smooth;
        let computed_normals = is_smooth && self.compute_normals(&mut encoder, options.crease_angle_deg);
        let pipeline = MeshPipeline {
            geometry: match (by_corner, is_smooth) {
                (false, _) => Geometry::Indexed,
                (true, false) => Geometry::Flat,
                (true, true) => Geometry::Smooth,
            },
            has_details: by_corner && options.has_details(),
            is_cut: options.unit_section().is_some(),
        };
        let image = Image { target, options, pipeline, lines: self.upload_lines(&camera, lattice) };
        self.encode_pass(&mut encoder, &image);
        self.queue.submit([encoder.finish()]);
        Ok(DrawStats { uploaded_bytes: plan.bytes(), computed_normals, is_smooth, has_details: pipeline.has_details })
    }

    fn write_globals(&self, mut globals: Globals) {
        globals.slot_end = self.mesh.slot_end();
        globals.capacity_slots = self.mesh.capacity_slots();
        self.queue.write_buffer(&self.globals, 0, bytemuck::bytes_of(&globals));
    }

    /// Makes the buffers for drawing by corner as large as the mesh's. False where the device cannot.
    fn prepare_corners(&mut self) -> bool {
        let Some(pipelines) = &self.pipelines.corners else { return false };
        if !CornerBuffers::fit(&self.device, self.mesh.capacity_slots()) {
            self.corners = None;
            return false;
        }
        if self.corners.as_ref().is_none_or(|corners| !corners.are_of(&self.mesh)) {
            self.corners = None;
            self.corners = Some(CornerBuffers::new(&self.device, pipelines, &self.mesh));
        }
        true
    }

    /// Computes normals unless they are there, and says whether it did.
    fn compute_normals(&mut self, encoder: &mut CommandEncoder, crease_angle_deg: f32) -> bool {
        let (Some(pipelines), Some(corners)) = (&self.pipelines.corners, &mut self.corners) else { return false };
        let crease = Some(crease_angle_deg.clamp(0.0, 180.0));
        if corners.computed_crease == crease {
            return false;
        }
        corners.compute_normals(&self.device, encoder, pipelines, &self.globals_group, self.mesh.slot_end());
        corners.computed_crease = crease;
        true
    }

    fn upload_lines(&self, camera: &CameraUniform, lattice: &Lattice) -> Option<(Buffer, u32)> {
        let lines = gpu_lines(&self.lines, camera, lattice);
        let buffer = (!lines.is_empty()).then(|| {
            self.device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some("lines"),
                contents: bytemuck::cast_slice(&lines),
                usage: BufferUsages::VERTEX,
            })
        })?;
        Some((buffer, lines.len() as u32))
    }

    fn encode_pass(&mut self, encoder: &mut CommandEncoder, image: &Image<'_>) {
        let canvas = self.canvas.as_ref().expect("resize comes before draw");
        let [r, g, b] = image.options.background.map(|byte| encode(self.format, byte));
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("mesh"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &canvas.color,
                depth_slice: None,
                resolve_target: Some(image.target),
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color { r, g, b, a: 1.0 }),
                    store: wgpu::StoreOp::Discard,
                },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &canvas.depth,
                depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard }),
                stencil_ops: None,
            }),
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        pass.set_bind_group(0, &self.globals_group, &[]);
        if image.options.background_top.is_some() {
            pass.set_pipeline(&self.pipelines.background);
            pass.draw(0..3, 0..1);
        }
        let corners = 6 * self.mesh.slot_end();
        if corners > 0 {
            pass.set_pipeline(self.pipelines.mesh(&self.device, image.pipeline));
            if image.pipeline.geometry == Geometry::Indexed {
                pass.set_vertex_buffer(0, self.mesh.vertices().slice(..));
                pass.set_index_buffer(self.mesh.indices().slice(..), wgpu::IndexFormat::Uint32);
                pass.draw_indexed(0..corners, 0, 0..1);
            } else {
                let buffers = self.corners.as_ref().expect("prepared for this geometry");
                pass.set_bind_group(1, &buffers.draw_group, &[]);
                pass.draw(0..corners, 0..1);
            }
        }
        if let Some((lines, count)) = &image.lines {
            pass.set_vertex_buffer(0, lines.slice(..));
            for (pipeline, instances) in
                [(&self.pipelines.hidden_lines, 0..count / 2), (&self.pipelines.lines, count / 2..*count)]
            {
                pass.set_pipeline(pipeline);
                pass.draw(0..4, instances);
            }
        }
    }
}
