//! What an image is drawn to before it is resolved: multisampled colour and depth.

use wgpu::{Device, TextureFormat, TextureUsages, TextureView};

use super::error::RenderError;
use super::pipeline::{DEPTH_FORMAT, SAMPLES};

/// Multisampled colour and depth of one size.
#[derive(Debug)]
pub(super) struct Canvas {
    pub(super) size: [u32; 2],
    pub(super) color: TextureView,
    pub(super) depth: TextureView,
}

impl Canvas {
    /// `reads_depth`: whether later passes read the depth.
    ///
    /// # Errors
    /// [`RenderError::ImageSize`].
    pub(super) fn new(
        device: &Device,
        format: TextureFormat,
        size: [u32; 2],
        reads_depth: bool,
    ) -> Result<Self, RenderError> {
        check_size(device, size[0], size[1])?;
        let view = |label, format, usage| {
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
        let depth_usage = if reads_depth { TextureUsages::TEXTURE_BINDING } else { TextureUsages::empty() };
        Ok(Self {
            size,
            color: view("color", format, TextureUsages::empty()),
            depth: view("depth", DEPTH_FORMAT, depth_usage),
        })
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
