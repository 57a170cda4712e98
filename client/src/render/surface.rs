//! What a window or a canvas shows: images of its size, whatever happens to it in between.
//!
//! Surfaces become outdated when their window changes and may be lost altogether. Both are answered here as far as possible:
//! [`SurfaceTarget::acquire`] gives an image, or says that there is none this time, or that the surface has to be made anew.
//! Knows no window system: whoever makes the [`wgpu::Surface`] keeps the window.

use wgpu::{CurrentSurfaceTexture, Device, PresentMode, Queue, Surface, SurfaceConfiguration, TextureFormat};

use super::error::RenderError;
use super::gpu::Gpu;

/// When images appear.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Pacing {
    /// With the screen: never torn, at most one per refresh.
    #[default]
    WithScreen,
    /// As soon as they are there, where the system can do that.
    Immediate,
}

/// A configured surface.
#[derive(Debug)]
pub struct SurfaceTarget<'w> {
    surface: Surface<'w>,
    device: Device,
    queue: Queue,
    /// Of the configuration that the surface has, if `is_configured`.
    config: SurfaceConfiguration,
    view_format: TextureFormat,
    is_configured: bool,
}

/// What [`SurfaceTarget::acquire`] found.
#[derive(Debug)]
pub enum Acquired {
    /// Draw to its view, then [`SurfaceTarget::present`] it.
    Image(SurfaceImage),
    /// Nothing can be shown now (hidden, without size, not ready): try again with the next event.
    Nothing,
    /// Make a new surface for the window, then a new target.
    Lost,
}

/// One image of a surface.
#[derive(Debug)]
pub struct SurfaceImage {
    texture: wgpu::SurfaceTexture,
    view: wgpu::TextureView,
}

impl SurfaceImage {
    /// What to draw to, of [`SurfaceTarget::format`].
    pub fn view(&self) -> &wgpu::TextureView {
        &self.view
    }
}

impl<'w> SurfaceTarget<'w> {
    /// A target for `surface`, which `gpu`'s adapter can present to. `size` in pixels; without any, nothing is shown until
    /// [`resize`](Self::resize).
    ///
    /// # Errors
    /// [`RenderError::NoSurfaceFormat`].
    pub fn new(gpu: &Gpu, surface: Surface<'w>, size: [u32; 2], pacing: Pacing) -> Result<Self, RenderError> {
        let capabilities = surface.get_capabilities(&gpu.adapter);
        let format = best_format(&capabilities.formats)
            .ok_or_else(|| RenderError::NoSurfaceFormat { adapter: gpu.adapter.get_info().name })?;
        // Canvases have no sRGB formats of their own, but views of them may.
        let flags = gpu.adapter.get_downlevel_capabilities().flags;
        // In browsers such a view may lose its encoding where samples are resolved (Chromium on SwiftShader), so shaders
        // encode there.
        let can_view = flags.contains(wgpu::DownlevelFlags::SURFACE_VIEW_FORMATS) && cfg!(not(target_arch = "wasm32"));
        let view_format = if can_view { format.add_srgb_suffix() } else { format };
        let config = SurfaceConfiguration {
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT,
            format,
            color_space: Default::default(),
            width: 0,
            height: 0,
            present_mode: present_mode(pacing),
            desired_maximum_frame_latency: 2,
            alpha_mode: opaque(&capabilities.alpha_modes),
            view_formats: if view_format == format { Vec::new() } else { vec![view_format] },
        };
        let mut target = Self {
            surface,
            device: gpu.device.clone(),
            queue: gpu.queue.clone(),
            config,
            view_format,
            is_configured: false,
        };
        target.resize(size);
        Ok(target)
    }

    /// Format of the views: that of the [`Renderer`](super::Renderer).
    pub fn format(&self) -> TextureFormat {
        self.view_format
    }

    /// Size of the images in pixels: as asked for, but no larger than the device's textures.
    pub fn size(&self) -> [u32; 2] {
        [self.config.width, self.config.height]
    }

    /// The window has this size in pixels now. A window without size shows nothing.
    pub fn resize(&mut self, size: [u32; 2]) {
        let largest = self.device.limits().max_texture_dimension_2d;
        let size = size.map(|side| side.min(largest));
        if size != self.size() {
            [self.config.width, self.config.height] = size;
            self.is_configured = false;
        }
    }

    /// When images appear from now on.
    pub fn set_pacing(&mut self, pacing: Pacing) {
        let mode = present_mode(pacing);
        if mode != self.config.present_mode {
            self.config.present_mode = mode;
            self.is_configured = false;
        }
    }

    /// The next image to draw. May wait for the screen.
    pub fn acquire(&mut self) -> Acquired {
        if self.size().contains(&0) {
            return Acquired::Nothing;
        }
        // Once more if the configuration turns out to be outdated; after that the next event is soon enough.
        for _ in 0..2 {
            if !self.is_configured {
                self.surface.configure(&self.device, &self.config);
                self.is_configured = true;
            }
            match self.surface.get_current_texture() {
                CurrentSurfaceTexture::Success(texture) => return self.image(texture),
                CurrentSurfaceTexture::Suboptimal(texture) => {
                    // Good enough to be shown; the next one fits again.
                    self.is_configured = false;
                    return self.image(texture);
                }
                CurrentSurfaceTexture::Outdated => self.is_configured = false,
                CurrentSurfaceTexture::Lost => return Acquired::Lost,
                CurrentSurfaceTexture::Timeout
                | CurrentSurfaceTexture::Occluded
                | CurrentSurfaceTexture::Validation => return Acquired::Nothing,
            }
        }
        Acquired::Nothing
    }

    /// Shows an image that was drawn to.
    pub fn present(&self, image: SurfaceImage) {
        self.queue.present(image.texture);
    }

    fn image(&self, texture: wgpu::SurfaceTexture) -> Acquired {
        let view = texture
            .texture
            .create_view(&wgpu::TextureViewDescriptor { format: Some(self.view_format), ..Default::default() });
        Acquired::Image(SurfaceImage { texture, view })
    }
}

/// The first format of 8 bits that encodes sRGB, else the first of 8 bits, else whatever there is first.
fn best_format(formats: &[TextureFormat]) -> Option<TextureFormat> {
    use TextureFormat::{Bgra8Unorm, Bgra8UnormSrgb, Rgba8Unorm, Rgba8UnormSrgb};
    let first_of = |wanted: [TextureFormat; 2]| formats.iter().copied().find(|format| wanted.contains(format));
    first_of([Bgra8UnormSrgb, Rgba8UnormSrgb])
        .or_else(|| first_of([Bgra8Unorm, Rgba8Unorm]))
        .or(formats.first().copied())
}

fn present_mode(pacing: Pacing) -> PresentMode {
    // Both fall back to what the system has.
    match pacing {
        Pacing::WithScreen => PresentMode::AutoVsync,
        Pacing::Immediate => PresentMode::AutoNoVsync,
    }
}

fn opaque(modes: &[wgpu::CompositeAlphaMode]) -> wgpu::CompositeAlphaMode {
    let opaque = wgpu::CompositeAlphaMode::Opaque;
    if modes.contains(&opaque) { opaque } else { wgpu::CompositeAlphaMode::Auto }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_that_encode_srgb_come_first() {
        use TextureFormat::{Bgra8Unorm, Rgb10a2Unorm, Rgba8UnormSrgb, Rgba16Float};
        assert_eq!(best_format(&[Rgba16Float, Bgra8Unorm, Rgba8UnormSrgb]), Some(Rgba8UnormSrgb));
        assert_eq!(best_format(&[Rgba16Float, Bgra8Unorm]), Some(Bgra8Unorm));
        assert_eq!(best_format(&[Rgb10a2Unorm, Rgba16Float]), Some(Rgb10a2Unorm));
        assert_eq!(best_format(&[]), None);
    }
}
