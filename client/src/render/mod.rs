//! Draws a replica with wgpu.
//!
//! A slot of the replica is an element of the GPU buffers, so an op changes a handful of elements and there is no remap
//! table. When an image is submitted the buffers equal the replica.
//!
//! - [`camera`]: the camera in the shaders' terms. [`upload`]: dirty slots to an upload plan, plain data.
//! - [`options`]: the shading formula. [`globals`]: camera and options for the shaders. [`lines`]: what is drawn on top.
//! - [`buffers`]: executes plans. `corners`: normals by corner. `occlusion`: darker crevices. [`morph`], [`ghosts`]: transitions. [`pipeline`]: shaders and pipelines. [`renderer`]: one image.
//! - [`gpu`]: instance, adapter, device. [`surface`]: windows and canvases. `readback`, `offscreen`, `image`: images without a window (not in browsers).
//!
//! This module reads replicas; it never sees messages and decides no op.

pub mod buffers;
pub mod camera;
#[cfg(all(feature = "web", target_arch = "wasm32"))]
pub mod canvas;
mod corners;
pub mod globals;
pub mod gpu;
#[cfg(not(target_arch = "wasm32"))]
pub mod image;
pub mod lines;
pub mod morph;
mod morph_buffers;
mod occlusion;
#[cfg(not(target_arch = "wasm32"))]
pub mod offscreen;
pub mod options;
pub mod pipeline;
#[cfg(not(target_arch = "wasm32"))]
pub mod readback;
pub mod renderer;
pub mod surface;
mod target;
pub mod upload;

pub mod ghosts;

mod error;

pub use camera::{CameraUniform, RenderCamera};
pub use error::RenderError;
pub use gpu::{Gpu, GpuOptions};
#[cfg(not(target_arch = "wasm32"))]
pub use image::Image;
pub use lines::Line;
#[cfg(not(target_arch = "wasm32"))]
pub use offscreen::{Offscreen, render_image};
pub use options::{RenderOptions, Shading};
pub use renderer::{DrawStats, Renderer};
pub use surface::{Acquired, Pacing, SurfaceTarget};
