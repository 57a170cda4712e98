//! Pictures of models without a GPU: the thumbnail of a pack.
//!
//! The same model gives the same bytes on every machine: floats meet only + - * / and square roots, in a fixed order.
//! [`raster`](self) draws triangles into samples, `encode` makes a PNG that keeps a length. This module knows packs and the
//! selection of ops, neither files nor HTTP.

mod camera;
mod encode;
mod raster;
#[cfg(test)]
mod tests;

use glam::DVec3;
use lodestream_protocol::view::View;

use self::camera::Camera;
pub use self::camera::Window;
use self::encode::Encoding;
pub use self::encode::window;
use self::raster::{Canvas, Surface};
use crate::mesh::TriMesh;
use crate::pack::{PackError, PackedModel, extract, replay_ops};
use crate::session::ops_for_view;

/// Pixels across and down.
pub const THUMBNAIL_SIZE: [u32; 2] = [320, 240];
/// Most bytes of a thumbnail.
pub const MAX_THUMBNAIL_BYTES: usize = 30 << 10;

/// Triangles of the mesh that is drawn: about one for each two pixels of the object.
const TRIANGLES: u32 = 30_000;

/// Samples per pixel and direction.
const OVERSAMPLING: u32 = 3;

/// Draws a model as the viewer first shows it, as large as it fits, on nothing: a PNG of at most [`MAX_THUMBNAIL_BYTES`], which
/// says what part of the viewer's image it is ([`window`]).
///
/// Draws the best mesh of 30,000 triangles (or the base, if it has more), so it costs the same for any model: some tens of
/// milliseconds, and the memory of that mesh. An empty model gives an empty picture.
///
/// # Errors
/// [`PackError`] if a page is damaged or a record does not fit.
pub fn thumbnail(model: &PackedModel) -> Result<Vec<u8>, PackError> {
    let mut view = View::perspective(DVec3::Z, DVec3::ZERO, 1.0);
    view.complete = true;
    view.triangle_limit = TRIANGLES.max(model.info().smallest_limit);
    let ops = ops_for_view(model, &view)?;
    let mesh = extract(model, &replay_ops(model, ops.into_iter())?);
    let info = model.info();
    let [low, high] = [info.box_min, info.box_max].map(|corner| DVec3::from_array(info.lattice.position(corner)));
    let ball = (((low + high) / 2.0).to_array(), ((high - low).length() / 2.0).max(info.lattice.step));
    Ok(draw(&mesh, ball, info.is_open))
}

/// The picture of a mesh within a ball of this centre and radius. Faces that face away are drawn too if the inside `is_open` to
/// the eye.
fn draw(mesh: &TriMesh, ball: ([f64; 3], f64), is_open: bool) -> Vec<u8> {
    let [width, height] = THUMBNAIL_SIZE.map(|pixels| pixels * OVERSAMPLING);
    let mut canvas = Canvas::new(width, height);
    let camera = Camera::framing(ball, &mesh.positions, width, height);
    if let Some(camera) = &camera {
        Surface { mesh, camera, is_open }.draw(&mut canvas);
    }
    let window = camera.map(|camera| camera.window);
    encode::within(
        &canvas,
        Encoding { oversampling: OVERSAMPLING, is_clay: mesh.colors.is_none(), window },
        MAX_THUMBNAIL_BYTES,
    )
}
