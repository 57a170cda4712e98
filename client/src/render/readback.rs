//! A target without a window, and its pixels back on the CPU.

use std::sync::mpsc;

use wgpu::{Device, Queue, TextureFormat, TextureView};

use super::error::RenderError;
use super::image::Image;
use super::target::check_size;

/// Format of targets that are read back.
pub const FORMAT: TextureFormat = TextureFormat::Rgba8UnormSrgb;

/// A texture to draw to.
#[derive(Debug)]
pub struct OffscreenTarget {
    texture: wgpu::Texture,
    view: TextureView,
}

impl OffscreenTarget {
    /// A target of [`FORMAT`].
    ///
    /// # Errors
    /// [`RenderError::ImageSize`].
    pub fn new(device: &Device, width: u32, height: u32) -> Result<Self, RenderError> {
        check_size(device, width, height)?;
        let limit = device.limits();
        if u64::from(padded_row(width)) * u64::from(height) > limit.max_buffer_size {
            return Err(RenderError::ImageSize { width, height, limit: limit.max_texture_dimension_2d });
        }
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("offscreen"),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: FORMAT,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let view = texture.create_view(&Default::default());
        Ok(Self { texture, view })
    }

    /// What to draw to.
    pub fn view(&self) -> &TextureView {
        &self.view
    }

    /// Width and height in pixels.
    pub fn size(&self) -> [u32; 2] {
        [self.texture.width(), self.texture.height()]
    }

    /// Waits for what was submitted and returns the pixels.
    ///
    /// # Errors
    /// [`RenderError::Readback`] if the device is lost.
    pub fn read(&self, device: &Device, queue: &Queue) -> Result<Image, RenderError> {
        let [width, height] = self.size();
        let row = padded_row(width);
        let buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("readback"),
            size: u64::from(row) * u64::from(height),
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        let mut encoder = device.create_command_encoder(&Default::default());
        encoder.copy_texture_to_buffer(
            self.texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &buffer,
                layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row), rows_per_image: None },
            },
            self.texture.size(),
        );
        queue.submit([encoder.finish()]);
        let padded = read_mapped(device, &buffer)?;
        let rgba = padded.chunks_exact(row as usize).flat_map(|line| &line[..width as usize * 4]).copied().collect();
        Ok(Image { width, height, rgba })
    }
}

/// The bytes of `source`, which has usage `COPY_SRC`, once all that was submitted is done. For tests and tools.
///
/// # Errors
/// [`RenderError::Readback`] if the device is lost.
pub fn read_buffer(device: &Device, queue: &Queue, source: &wgpu::Buffer) -> Result<Vec<u8>, RenderError> {
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("readback"),
        size: source.size(),
        usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&Default::default());
    encoder.copy_buffer_to_buffer(source, 0, &buffer, 0, source.size());
    queue.submit([encoder.finish()]);
    read_mapped(device, &buffer)
}

fn read_mapped(device: &Device, buffer: &wgpu::Buffer) -> Result<Vec<u8>, RenderError> {
    let failed = |e: &dyn std::fmt::Display| RenderError::Readback(e.to_string());
    let (send, receive) = mpsc::channel();
    buffer.map_async(wgpu::MapMode::Read, .., move |result| {
        // The receiver waits below; if it is gone, nobody wants the answer.
        send.send(result).ok();
    });
    device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| failed(&e))?;
    receive.recv().map_err(|e| failed(&e))?.map_err(|e| failed(&e))?;
    let bytes = buffer.get_mapped_range(..).map_err(|e| failed(&e))?.to_vec();
    buffer.unmap();
    Ok(bytes)
}

/// Bytes of a row in a buffer that a texture is copied to.
fn padded_row(width: u32) -> u32 {
    (width * 4).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT)
}
