//! What an image is drawn to before it is resolved: multisampled colour and depth.

use wgpu::{Device, TextureFormat, TextureUsages, TextureView};

use super::error::RenderError;
use super::pipeline::{DEPTH_FORMAT, SAMPLES};

/// Multisampled colour and depth of one size.
#[derive(Debug)]
pub(super) struct Canvas {
    pub(super) size: [u32; 2],
    pub(super) is_read: bool,
    pub(super) color: TextureView,
    pub(super) depth: TextureView,
}

impl Canvas {
    /// `is_read`: whether later passes read colour and depth.
    ///
    /// # Errors
    /// [`RenderError::ImageSize`].
    pub(super) fn new(
        device: &Device,
        format: TextureFormat,
        size: [u32; 2],
        is_read: bool,
    ) -> Result<Self, RenderError> {
        check_size(device, size[0], size[1])?;
        let usage = if is_read { TextureUsages::TEXTURE_BINDING } else { TextureUsages::empty() };
        let view = |label, format| {
            let texture = device.create_texture(&wgpu::TextureDescriptor {
                label: Some(label),
                size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: SAMPLES,
                dimension: wgpu::TextureDimension::D2,
                format,
                usage: TextureUsages::RENDER_ATTACHMENT | usage,
                view_formats: &[],
            });
            texture.create_view(&Default::default())
        };
        Ok(Self { size, is_read, color: view("color", format), depth: view("depth", DEPTH_FORMAT) })
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
