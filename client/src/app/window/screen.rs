//! What the window shows: the scene, and the panel on top of it.

use std::sync::Arc;

use winit::window::Window;

use super::super::viewer::Scene;
use crate::render::readback::{FORMAT, OffscreenTarget};
use crate::render::{Acquired, DrawStats, Gpu, GpuOptions, Image, Line, Pacing, RenderError, Renderer, SurfaceTarget};

/// Surface, device and what draws.
pub(super) struct Screen {
    window: Arc<Window>,
    gpu: Gpu,
    target: SurfaceTarget<'static>,
    renderer: Renderer,
    panel: egui_wgpu::Renderer,
}

/// A panel ready to be drawn.
pub(super) struct PaintedPanel {
    pub(super) primitives: Vec<egui::ClippedPrimitive>,
    pub(super) textures: egui::TexturesDelta,
    pub(super) pixels_per_point: f32,
}

/// What came of an image.
pub(super) enum Painted {
    /// It is on the screen; what the scene cost, if there was one.
    Shown(Option<DrawStats>),
    /// The window cannot show anything now.
    Hidden,
    /// The device is gone: another [`Screen`] is needed.
    Lost,
}

impl Screen {
    /// Finds a device that can draw to the window.
    ///
    /// # Errors
    /// [`RenderError`].
    pub(super) fn open(window: Arc<Window>) -> Result<Self, RenderError> {
        let instance = Gpu::instance();
        let surface = make_surface(&instance, &window)?;
        let gpu = pollster::block_on(Gpu::new(instance, Some(&surface), &GpuOptions::from_env()))?;
        let target = SurfaceTarget::new(&gpu, surface, window.inner_size().into(), Pacing::WithScreen)?;
        let renderer = Renderer::new(&gpu.device, &gpu.queue, target.format());
        let panel = egui_wgpu::Renderer::new(&gpu.device, target.format(), egui_wgpu::RendererOptions::default());
        Ok(Self { window, gpu, target, renderer, panel })
    }

    /// What draws, for people.
    pub(super) fn describe(&self) -> String {
        self.gpu.describe()
    }

    /// Longest side of a texture.
    pub(super) fn max_texture_side(&self) -> usize {
        self.gpu.device.limits().max_texture_dimension_2d as usize
    }

    /// The window has another size in pixels.
    pub(super) fn resize(&mut self, size: [u32; 2]) {
        self.target.resize(size);
    }

    /// Draws and shows one image.
    ///
    /// # Errors
    /// [`RenderError`]: the scene cannot be drawn, or the window shows nothing any more.
    pub(super) fn paint(
        &mut self,
        scene: Option<Scene<'_>>,
        lines: &[Line],
        mut panel: PaintedPanel,
    ) -> Result<Painted, RenderError> {
        if self.gpu.is_lost() {
            // Nothing can be made of them; a new context says all of them again.
            panel.textures.clear();
            return Ok(Painted::Lost);
        }
        // Textures are told once, whether the image is shown or not.
        for (id, deltas) in std::mem::take(&mut panel.textures.set) {
            for delta in &deltas {
                self.panel.update_texture(&self.gpu.device, &self.gpu.queue, id, delta);
            }
        }
        let painted = self.paint_with(scene, lines, &panel);
        for id in std::mem::take(&mut panel.textures.free) {
            self.panel.free_texture(&id);
        }
        painted
    }

    fn paint_with(
        &mut self,
        scene: Option<Scene<'_>>,
        lines: &[Line],
        panel: &PaintedPanel,
    ) -> Result<Painted, RenderError> {
        let image = match self.target.acquire() {
            Acquired::Image(image) => image,
            Acquired::Nothing => return Ok(Painted::Hidden),
            Acquired::Lost => {
                let surface = make_surface(&self.gpu.instance, &self.window)?;
                self.target = SurfaceTarget::new(&self.gpu, surface, self.target.size(), Pacing::WithScreen)?;
                return Ok(Painted::Hidden);
            }
        };
        let [width, height] = self.target.size();
        let mut stats = None;
        if let Some(scene) = scene {
            self.renderer.resize(width, height)?;
            self.renderer.set_lines(lines);
            let Scene { replica, lattice, camera, options } = scene;
            stats = Some(self.renderer.draw(image.view(), replica, &lattice, &camera, &options)?);
        }
        // What is made for the panel is not to be had from a device that was lost meanwhile.
        if self.gpu.is_lost() {
            return Ok(Painted::Lost);
        }
        self.draw_panel(image.view(), [width, height], stats.is_some(), panel);
        self.window.pre_present_notify();
        self.target.present(image);
        Ok(Painted::Shown(stats))
    }

    fn draw_panel(&mut self, view: &wgpu::TextureView, size: [u32; 2], has_scene: bool, panel: &PaintedPanel) {
        let screen = egui_wgpu::ScreenDescriptor { size_in_pixels: size, pixels_per_point: panel.pixels_per_point };
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let (device, queue) = (&self.gpu.device, &self.gpu.queue);
        let mut commands = self.panel.update_buffers(device, queue, &mut encoder, &panel.primitives, &screen);
        let load = match has_scene {
            true => wgpu::LoadOp::Load,
            false => wgpu::LoadOp::Clear(wgpu::Color { r: 0.013, g: 0.015, b: 0.019, a: 1.0 }),
        };
        let pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("panel"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
            })],
            depth_stencil_attachment: None,
            timestamp_writes: None,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        self.panel.render(&mut pass.forget_lifetime(), &panel.primitives, &screen);
        commands.push(encoder.finish());
        queue.submit(commands);
    }

    /// The device is lost, as it is when a driver is reset.
    pub(super) fn lose_device(&self) {
        self.gpu.device.destroy();
        // That it is gone is told when it is asked.
        let _ = self.gpu.device.poll(wgpu::PollType::Poll);
    }

    /// The scene without the panel. Whoever follows the replica begins anew afterwards.
    ///
    /// # Errors
    /// [`RenderError`].
    pub(super) fn picture(&self, scene: Scene<'_>, lines: &[Line]) -> Result<Image, RenderError> {
        let [width, height] = self.target.size();
        let Scene { replica, lattice, camera, mut options } = scene;
        options.geomorph = None;
        let target = OffscreenTarget::new(&self.gpu.device, width, height)?;
        let mut renderer = Renderer::new(&self.gpu.device, &self.gpu.queue, FORMAT);
        renderer.resize(width, height)?;
        renderer.set_lines(lines);
        replica.track_dirty();
        let drawn = renderer.draw(target.view(), replica, &lattice, &camera, &options);
        replica.track_dirty();
        drawn?;
        target.read(&self.gpu.device, &self.gpu.queue)
    }
}

fn make_surface(instance: &wgpu::Instance, window: &Arc<Window>) -> Result<wgpu::Surface<'static>, RenderError> {
    instance.create_surface(window.clone()).map_err(|error| RenderError::NoSurface(error.to_string()))
}
