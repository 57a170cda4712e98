//! A device for a canvas in a browser.

use super::error::RenderError;
use super::gpu::{Gpu, GpuOptions};

/// A device that can draw to the canvas, and the canvas as a surface.
///
/// # Errors
/// See [`Gpu::new`]; [`RenderError::NoAdapter`] if the canvas gives no context.
pub async fn canvas_gpu(canvas: web_sys::HtmlCanvasElement) -> Result<(Gpu, wgpu::Surface<'static>), RenderError> {
    let instance = Gpu::instance();
    let surface = instance.create_surface(wgpu::SurfaceTarget::Canvas(canvas)).map_err(|_| RenderError::NoAdapter)?;
    let options = GpuOptions { as_webgl: cfg!(feature = "webgl"), ..GpuOptions::default() };
    let gpu = Gpu::new(instance, Some(&surface), &options).await?;
    Ok((gpu, surface))
}
