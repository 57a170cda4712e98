//! Images without a GPU's clutter: a device, a camera, what a pixel should be. Not every test uses all of it.
#![allow(dead_code)]

use glam::{DVec3, Vec3};
use lodestream_client::render::options::{CLAY_LINEAR, light, srgb_encode};
use lodestream_client::render::{GpuOptions, Image, Offscreen, RenderCamera, RenderError, RenderOptions, Shading};
use lodestream_protocol::mesh::Replica;
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::view::{Projection, look_along};

use crate::meshes::{Soup, lattice};

pub(crate) const SIZE: [u32; 2] = [640, 480];
pub(crate) const FOV_Y_RAD: f32 = 0.8;

/// A device and the lattice of the test meshes.
pub(crate) struct Studio {
    pub(crate) offscreen: Offscreen,
    pub(crate) lattice: Lattice,
}

impl Studio {
    pub(crate) fn open() -> Option<Self> {
        Self::with(&GpuOptions::from_env())
    }

    /// As a browser with nothing but WebGL 2 has it.
    pub(crate) fn as_webgl() -> Option<Self> {
        Self::with(&GpuOptions { as_webgl: true, ..GpuOptions::from_env() })
    }

    fn with(options: &GpuOptions) -> Option<Self> {
        match Offscreen::new(options) {
            Ok(offscreen) => Some(Self { offscreen, lattice: lattice() }),
            Err(RenderError::NoAdapter) => {
                eprintln!("skipped: no graphics adapter");
                None
            }
            Err(e) => panic!("{e}"),
        }
    }

    pub(crate) fn shoot(
        &mut self,
        name: &str,
        replica: &mut Replica,
        camera: &RenderCamera,
        options: &RenderOptions,
    ) -> Image {
        let image = self.offscreen.render(replica, &self.lattice, camera, SIZE, options).expect("it draws");
        if let Some(dir) = std::env::var_os("LODESTREAM_TEST_IMAGES") {
            image.write_png(&std::path::Path::new(&dir).join(format!("{name}.png"))).expect("the folder exists");
        }
        image
    }

    pub(crate) fn shoot_soup(
        &mut self,
        name: &str,
        soup: &Soup,
        camera: &RenderCamera,
        options: &RenderOptions,
    ) -> Image {
        self.shoot(name, &mut soup.replica(&self.lattice), camera, options)
    }
}

pub(crate) fn looking(eye: DVec3, target: DVec3) -> RenderCamera {
    RenderCamera {
        eye,
        rotation: look_along((target - eye).normalize(), DVec3::Y),
        projection: Projection::Perspective { fov_y_rad: FOV_Y_RAD },
        near: 0.01,
    }
}

pub(crate) fn shaded(shading: Shading) -> RenderOptions {
    RenderOptions { shading, ..RenderOptions::default() }
}

pub(crate) fn background() -> [u8; 3] {
    RenderOptions::default().background
}

/// Light under the default options.
pub(crate) fn key_light(n: Vec3) -> f32 {
    light(n, RenderOptions::default().light_direction())
}

/// The shade of a surface with normal `n` in camera coordinates.
pub(crate) fn clay(n: Vec3) -> [f32; 3] {
    CLAY_LINEAR.map(|c| srgb_encode(c * key_light(n)))
}

/// Share of the pixels that are not background, edges counted in half.
pub(crate) fn covered(image: &Image) -> f64 {
    image.rgba.chunks_exact(4).filter(|p| p[..3] != background()).count() as f64
}

pub(crate) fn assert_close(got: [u8; 3], expected: [f32; 3], bound: f32) {
    let off = (0..3).map(|k| (f32::from(got[k]) - expected[k]).abs()).fold(0.0, f32::max);
    assert!(off <= bound, "{got:?} is not {expected:?} within {bound}");
}
