//! Images without a window.

use lodestream_protocol::mesh::Replica;
use lodestream_protocol::quant::Lattice;

use super::camera::RenderCamera;
use super::error::RenderError;
use super::gpu::{Gpu, GpuOptions};
use super::image::Image;
use super::options::RenderOptions;
use super::readback::{FORMAT, OffscreenTarget};
use super::renderer::{DrawStats, Renderer};

/// A device, a renderer and a target of the last size: for a series of images of one replica.
#[derive(Debug)]
pub struct Offscreen {
    gpu: Gpu,
    renderer: Renderer,
    target: Option<OffscreenTarget>,
    stats: DrawStats,
}

impl Offscreen {
    /// Finds a device and compiles the pipelines.
    ///
    /// # Errors
    /// See [`Gpu::new`].
    pub fn new(options: &GpuOptions) -> Result<Self, RenderError> {
        let gpu = Gpu::offscreen(options)?;
        let renderer = Renderer::new(&gpu.device, &gpu.queue, FORMAT);
        Ok(Self { gpu, renderer, target: None, stats: DrawStats::default() })
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// The renderer.
    pub fn renderer(&self) -> &Renderer {
        &self.renderer
    }

    /// The renderer, for what it draws besides the mesh.
    pub fn renderer_mut(&mut self) -> &mut Renderer {
        &mut self.renderer
    }

    /// What the last image cost.
    pub fn stats(&self) -> DrawStats {
        self.stats
    }

    /// Draws the replica `[width, height]` pixels large. Uploads only what changed since the last image; see [`Renderer`]
    /// about replicas that others draw too.
    ///
    /// # Errors
    /// [`RenderError::ImageSize`], [`RenderError::MeshTooLarge`], [`RenderError::Readback`].
    pub fn render(
        &mut self,
        replica: &mut Replica,
        lattice: &Lattice,
        camera: &RenderCamera,
        size: [u32; 2],
        options: &RenderOptions,
    ) -> Result<Image, RenderError> {
        let target = match self.target.take() {
            Some(target) if target.size() == size => target,
            _ => OffscreenTarget::new(&self.gpu.device, size[0], size[1])?,
        };
        self.renderer.resize(size[0], size[1])?;
        self.stats = self.renderer.draw(target.view(), replica, lattice, camera, options)?;
        let image = target.read(&self.gpu.device, &self.gpu.queue);
        self.target = Some(target);
        image
    }
}

/// One image on the adapter that [`GpuOptions::from_env`] names. Whoever else follows the replica's dirty record finds
/// everything touched afterwards.
///
/// # Errors
/// See [`Offscreen::new`] and [`Offscreen::render`].
pub fn render_image(
    replica: &mut Replica,
    lattice: &Lattice,
    camera: &RenderCamera,
    size: [u32; 2],
    options: &RenderOptions,
) -> Result<Image, RenderError> {
    let mut offscreen = Offscreen::new(&GpuOptions::from_env())?;
    replica.track_dirty();
    let image = offscreen.render(replica, lattice, camera, size, options);
    replica.track_dirty();
    image
}
