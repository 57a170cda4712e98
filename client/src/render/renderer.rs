//! One image of a replica: upload what changed, compute normals, draw.

use std::time::Duration;

use lodestream_protocol::mesh::{Birth, Replica};
use lodestream_protocol::quant::Lattice;
use wgpu::util::DeviceExt;
use wgpu::{BindGroup, Buffer, BufferUsages, CommandEncoder, Device, Queue, TextureFormat, TextureView};

use super::buffers::MeshBuffers;
use super::camera::{CameraUniform, RenderCamera};
use super::corners::CornerBuffers;
use super::error::RenderError;
use super::ghosts::{Ghosts, MOST_GHOST_BYTES};
use super::globals::{Globals, encode};
use super::lines::{Line, gpu_lines};
use super::morph::{MorphView, Morphs, Motion};
use super::morph_buffers::{MorphBuffers, MorphPipeline};
use super::occlusion::{OcclusionBuffers, OcclusionPipelines};
use super::options::{RenderOptions, Shading};
use super::pipeline::{Geometry, MeshPipeline, Pipelines};
use super::target::Canvas;
use super::upload::UploadPlan;

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
    occlusion_pipelines: Option<OcclusionPipelines>,
    /// Of the canvas.
    occlusion: Option<OcclusionBuffers>,
    lines: Vec<Line>,
    morphs: Morphs,
    ghosts: Ghosts,
    ghost_corners: Option<Buffer>,
    motion: Motion,
    morph_pipeline: Option<MorphPipeline>,
    morph_buffers: Option<MorphBuffers>,
}

/// What an image cost, and which of its options this device could not do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DrawStats {
    /// Bytes written to the mesh buffers and for transitions.
    pub uploaded_bytes: u64,
    /// Faces that collapses took away and that are fading.
    pub ghosts: u32,
    /// Whether vertices are on their way to their places, or faces fade: the next image will differ though nothing else changes.
    pub is_moving: bool,
    /// Whether normals were computed.
    pub computed_normals: bool,
    /// Whether smooth shading was asked for and possible.
    pub is_smooth: bool,
    /// Whether occlusion was asked for and possible.
    pub has_occlusion: bool,
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
    has_occlusion: bool,
    /// Vertices are drawn where they are shown.
    is_moving: bool,
    shows_ghosts: bool,
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
            occlusion_pipelines: None,
            occlusion: None,
            lines: Vec::new(),
            morphs: Morphs::default(),
            ghosts: Ghosts::default(),
            ghost_corners: None,
            motion: Motion::default(),
            morph_pipeline: None,
            morph_buffers: None,
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
        let held = self.canvas.as_ref();
        if held.is_some_and(|canvas| canvas.size == size) {
            return Ok(());
        }
        let is_read = held.is_some_and(|canvas| canvas.is_read);
        self.replace_canvas(size, is_read)
    }

    fn replace_canvas(&mut self, size: [u32; 2], is_read: bool) -> Result<(), RenderError> {
        // The old one goes first: both may not fit at once.
        self.occlusion = None;
        self.canvas = None;
        self.canvas = Some(Canvas::new(&self.device, self.format, size, is_read)?);
        Ok(())
    }

    /// Uploads what changed, draws the replica to `target`, which has the size of the last [`resize`](Self::resize), and
    /// submits. The buffers equal the replica then.
    ///
    /// # Errors
    /// [`RenderError::MeshTooLarge`], [`RenderError::ImageSize`]; nothing is drawn then.
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
        let births = replica.dirty_mut().and_then(|dirty| dirty.take_births());
        if let Some(corners) = &mut self.corners
            && !plan.is_empty()
        {
            corners.computed_crease = None;
        }
        let size = self.canvas.as_ref().expect("resize comes before draw").size;
        let aspect = f64::from(size[0]) / f64::from(size[1]);
        let camera = CameraUniform::new(camera, lattice, aspect, options.light_direction());
        let has_occlusion = options.occlusion > 0.0 && self.prepare_occlusion(size)?;
        let mut globals = Globals::new(camera, lattice, options, size, self.format);
        globals.section_alpha = if has_occlusion { 0.0 } else { 1.0 };
        let view =
            MorphView { camera: &camera, size, extent: lattice.max_coordinate() as f32, duration: Duration::ZERO };
        let (is_moving, morph_bytes) = match options.geomorph {
            Some(now) => self.advance(now, births, &plan, replica, view),
            None => {
                // What happens from here on is not followed, so nothing may be built on it later.
                (self.morphs, self.morph_buffers) = (Morphs::default(), None);
                self.ghosts.forget();
                (false, 0)
            }
        };
        (globals.morph_now_s, globals.morph_share) = (self.morphs.now_s(), self.morphs.share());
        self.write_globals(globals);
        if let (true, Some(pipeline), Some(buffers)) = (is_moving, &self.morph_pipeline, &self.morph_buffers) {
            buffers.encode(&self.device, &mut encoder, pipeline, &self.globals_group, self.mesh.slot_end());
        }

        let by_corner = (options.shading == Shading::Smooth || options.has_details())
            && self.prepare_corners(&mut encoder, is_moving);
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
        let image = Image {
            target,
            options,
            pipeline,
            lines: self.upload_lines(&camera, lattice),
            has_occlusion,
            is_moving,
            // Edges and levels are of the mesh as it is.
            shows_ghosts: !pipeline.has_details,
        };
        self.encode_pass(&mut encoder, &image);
        if let (true, Some(pipelines), Some(buffers)) = (has_occlusion, &self.occlusion_pipelines, &self.occlusion) {
            buffers.encode(&mut encoder, pipelines, &self.globals_group, target, pipeline.is_cut);
        }
        self.queue.submit([encoder.finish()]);
        Ok(DrawStats {
            uploaded_bytes: plan.bytes() + morph_bytes,
            is_moving,
            ghosts: if is_moving { self.ghosts.ghosts().len() as u32 } else { 0 },
            computed_normals,
            is_smooth,
            has_occlusion,
            has_details: pipeline.has_details,
        })
    }

    fn write_globals(&self, mut globals: Globals) {
        globals.slot_end = self.mesh.slot_end();
        globals.capacity_slots = self.mesh.capacity_slots();
        self.queue.write_buffer(&self.globals, 0, bytemuck::bytes_of(&globals));
    }

    /// Lets transitions begin and says whether any runs, and how many bytes that took. Nothing moves on devices without
    /// storage buffers.
    fn advance(
        &mut self,
        now: Duration,
        births: Option<Vec<Birth>>,
        plan: &UploadPlan,
        replica: &Replica,
        mut view: MorphView<'_>,
    ) -> (bool, u64) {
        if self.pipelines.corners.is_none() {
            return (false, 0);
        }
        let births = births.filter(|_| !self.morphs.is_empty());
        view.duration = self.motion.follow(now, view.camera, view.extent);
        self.morphs.tick(now);
        match &births {
            Some(births) => {
                let made = self.ghosts.haunt(births, &plan.face_pairs, replica, &self.morphs, &view);
                if made > 0 {
                    self.morphs.hold(self.morphs.now_s() + view.duration.as_secs_f32());
                }
            }
            None => self.ghosts.forget(),
        }
        self.morphs.begin(births.as_deref(), &plan.vertices, replica, &view);
        self.ghosts.note_shown(&plan.vertices, &plan.face_pairs, replica);
        let ghost_bytes = self.upload_ghosts();
        if !self.morphs.is_running() {
            return (false, 0);
        }
        let pipeline =
            self.morph_pipeline.get_or_insert_with(|| MorphPipeline::new(&self.device, &self.pipelines.globals));
        let mut changed = self.morphs.take_changed();
        if self.morph_buffers.as_ref().is_none_or(|buffers| !buffers.are_of(&self.mesh)) {
            self.morph_buffers = None;
            self.morph_buffers = Some(MorphBuffers::new(&self.device, pipeline, &self.mesh));
            // New buffers are all zeros, which is a vertex in its place.
            changed = self.morphs.on_their_way();
        }
        let bytes = self.morph_buffers.as_ref().map_or(0, |buffers| buffers.write(&self.queue, &self.morphs, &changed));
        (true, bytes + ghost_bytes)
    }

    /// Makes the buffer of ghosts equal their list, and returns how many bytes that took.
    fn upload_ghosts(&mut self) -> u64 {
        let ghosts = self.ghosts.ghosts();
        let data: &[u8] = bytemuck::cast_slice(ghosts.as_flattened());
        if ghosts.is_empty() || !self.ghosts.has_changed() {
            return 0;
        }
        let buffer = self.ghost_corners.get_or_insert_with(|| {
            self.device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("ghosts"),
                size: MOST_GHOST_BYTES,
                usage: BufferUsages::VERTEX | BufferUsages::COPY_DST,
                mapped_at_creation: false,
            })
        });
        self.queue.write_buffer(buffer, 0, data);
        let bytes = data.len() as u64;
        self.ghosts.note_uploaded();
        bytes
    }

    /// Makes what occlusion needs. False where the device cannot: passes that read samples are beyond WebGL.
    fn prepare_occlusion(&mut self, size: [u32; 2]) -> Result<bool, RenderError> {
        if self.pipelines.corners.is_none() {
            return Ok(false);
        }
        if self.canvas.as_ref().is_none_or(|canvas| !canvas.is_read) {
            self.replace_canvas(size, true)?;
        }
        let pipelines = self
            .occlusion_pipelines
            .get_or_insert_with(|| OcclusionPipelines::new(&self.device, &self.pipelines.globals, self.format));
        if let (None, Some(canvas)) = (&self.occlusion, &self.canvas) {
            self.occlusion = Some(OcclusionBuffers::new(&self.device, pipelines, canvas));
        }
        Ok(true)
    }

    /// Makes the buffers for drawing by corner as large as the mesh's. False where the device cannot.
    fn prepare_corners(&mut self, encoder: &mut CommandEncoder, is_moving: bool) -> bool {
        let Some(pipelines) = &self.pipelines.corners else { return false };
        if !CornerBuffers::fit(&self.device, self.mesh.capacity_slots()) {
            self.corners = None;
            return false;
        }
        let held = self.corners.take();
        let shown = self.morph_buffers.as_ref().filter(|_| is_moving).map(|buffers| buffers.shown());
        let (mut corners, outgrown) = match held {
            Some(corners) if corners.are_of(&self.mesh) => (corners, None),
            outgrown => {
                // Of what is not needed as a beginning, the old goes first: both may not fit at once.
                let outgrown = outgrown.filter(|_| is_moving);
                (CornerBuffers::new(&self.device, pipelines, &self.mesh), outgrown)
            }
        };
        match shown {
            Some(shown) if !corners.is_moving() => {
                corners.begin_to_move(&self.device, encoder, pipelines, &self.mesh, shown, outgrown.as_ref());
            }
            Some(_) => {}
            None => corners.stop_moving(),
        }
        self.corners = Some(corners);
        true
    }

    /// Computes normals unless they are there, and says whether it did. Those that are shown follow.
    fn compute_normals(&mut self, encoder: &mut CommandEncoder, crease_angle_deg: f32) -> bool {
        let (Some(pipelines), Some(corners)) = (&self.pipelines.corners, &mut self.corners) else { return false };
        let (device, globals, slots) = (&self.device, &self.globals_group, self.mesh.slot_end());
        let crease = Some(crease_angle_deg.clamp(0.0, 180.0));
        let is_due = corners.computed_crease != crease;
        if is_due {
            corners.compute_normals(device, encoder, pipelines, globals, slots);
            corners.computed_crease = crease;
        }
        corners.follow(device, encoder, pipelines, globals, slots);
        is_due
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
        let keep = |is_kept| if is_kept { wgpu::StoreOp::Store } else { wgpu::StoreOp::Discard };
        let [r, g, b] = image.options.background.map(|byte| encode(self.format, byte));
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("mesh"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &canvas.color,
                depth_slice: None,
                resolve_target: Some(image.target),
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color { r, g, b, a: 1.0 }),
                    store: keep(image.has_occlusion && image.pipeline.is_cut),
                },
            })],
            depth_stencil_attachment: Some(wgpu::RenderPassDepthStencilAttachment {
                view: &canvas.depth,
                depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: keep(image.has_occlusion) }),
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
                let shown = self.morph_buffers.as_ref().filter(|_| image.is_moving).map(|buffers| buffers.shown());
                pass.set_vertex_buffer(0, shown.unwrap_or(self.mesh.vertices()).slice(..));
                pass.set_index_buffer(self.mesh.indices().slice(..), wgpu::IndexFormat::Uint32);
                pass.draw_indexed(0..corners, 0, 0..1);
            } else {
                let buffers = self.corners.as_ref().expect("prepared for this geometry");
                pass.set_bind_group(1, buffers.draw_group(), &[]);
                pass.draw(0..corners, 0..1);
            }
        }
        let ghosts = 3 * self.ghosts.ghosts().len() as u32;
        if let Some(corners) =
            self.ghost_corners.as_ref().filter(|_| image.is_moving && image.shows_ghosts && ghosts > 0)
        {
            pass.set_pipeline(&self.pipelines.ghosts);
            pass.set_vertex_buffer(0, corners.slice(..));
            pass.draw(0..ghosts, 0..1);
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
