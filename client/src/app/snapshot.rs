//! `lodestream snapshot`: connects, streams one view, writes what was asked for and ends.

use std::fmt;
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use glam::DVec3;
use lodestream_protocol::message::{CloseCode, ModelInfo};
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::ViewError;
use serde::Serialize;

use super::drive::{DriveError, Until, WayBack, drive};
use super::file::{FileError, check_folder, write_aside};
use super::ply::write_ply;
use crate::camera::{Camera, Detail, Viewport};
use crate::core::{ClientConfig, ClientError, ClientSession, Stats};
use crate::net::link::LinkShape;
use crate::net::native::{self, Connection, NetError};
use crate::net::target::Target;

/// Least time between two progress lines.
const PROGRESS_INTERVAL: Duration = Duration::from_millis(100);

/// What to stream and what to write.
#[derive(Clone, Debug, PartialEq)]
pub struct SnapshotOptions {
    /// The model.
    pub target: Target,
    /// Size of the image.
    pub viewport: Viewport,
    /// Eye and the point looked at, in model units; `None` frames the whole model.
    pub pose: Option<(DVec3, DVec3)>,
    /// Vertical opening angle in radians.
    pub fov_y_rad: f32,
    /// How much to ask for.
    pub detail: Detail,
    /// How the image is drawn.
    pub look: Look,
    /// The simulated link.
    pub shape: LinkShape,
    /// When to stop.
    pub until: Until,
    /// For how long to try to connect again when the connection breaks.
    pub reconnect_for: Duration,
    /// PNG file for the image.
    pub output: Option<PathBuf>,
    /// PLY file for the mesh.
    pub export: Option<PathBuf>,
    /// JSON file for the [`Outcome`].
    pub stats: Option<PathBuf>,
}

/// How the image is drawn: what of the renderer's options a command line needs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Look {
    /// One shade per face.
    pub flat: bool,
    /// Edges of the faces.
    pub wireframe: bool,
    /// Colours by the size of the faces.
    pub refinement_colors: bool,
    /// Depth of the shadows in crevices, 0 to 1.
    pub occlusion: f32,
}

/// Why there is no snapshot.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SnapshotError {
    /// No connection.
    #[error(transparent)]
    Net(#[from] NetError),
    /// Streaming ended early. Nothing was written.
    #[error(transparent)]
    Drive(#[from] DriveError),
    /// A file could not be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The end came before the server had sent a mesh.
    #[error("no mesh has arrived by then: there is nothing to write")]
    NoMesh,
    /// The picture could not be drawn.
    #[cfg(feature = "render")]
    #[error(transparent)]
    Render(#[from] crate::render::RenderError),
    /// This program cannot draw.
    #[error("not built with the renderer: --output needs it, --export and --stats do not")]
    NoRenderer,
    /// The system grants no event queue.
    #[error("cannot start")]
    Start(#[source] io::Error),
}

/// What came of it: the content of `--stats`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// Name of the model on the server.
    pub model: String,
    /// Name for people, empty before the server has said it.
    pub title: String,
    /// Triangles of the complete model.
    pub model_triangles: u64,
    /// Vertices of the complete model.
    pub model_vertices: u64,
    /// Milliseconds from beginning to connect to the end of streaming.
    pub elapsed_ms: f64,
    /// What the session counted.
    #[serde(flatten)]
    pub stats: Stats,
}

/// Streams and writes. Blocks this thread; progress goes to standard error if that is a terminal.
///
/// # Errors
/// [`SnapshotError`]. Files are complete or absent, and none is written unless streaming came to its end.
pub fn run(options: &SnapshotOptions) -> Result<Outcome, SnapshotError> {
    if options.output.is_some() && !cfg!(feature = "render") {
        return Err(SnapshotError::NoRenderer);
    }
    for path in [&options.output, &options.export, &options.stats].into_iter().flatten() {
        check_folder(path)?;
    }
    let streamed = native::block_on(stream(options)).map_err(SnapshotError::Start)??;
    let Streamed { mut session, camera, elapsed } = streamed;

    let outcome = outcome(options, &session, elapsed);
    if let Some(path) = &options.export {
        let (replica, model) = session.replica().zip(session.model()).ok_or(SnapshotError::NoMesh)?;
        write_aside(path, |out| write_ply(out, replica, model))?;
    }
    if let Some(path) = &options.output {
        render_png(&mut session, camera.as_ref().ok_or(SnapshotError::NoMesh)?, options, path)?;
    }
    if let Some(path) = &options.stats {
        write_aside(path, |out| {
            serde_json::to_writer_pretty(&mut *out, &outcome)?;
            out.write_all(b"\n")
        })?;
    }
    Ok(outcome)
}

/// Draws the session's mesh and writes it as a PNG file: the one place where `snapshot` meets the renderer.
#[cfg(feature = "render")]
fn render_png(
    session: &mut ClientSession,
    camera: &Camera,
    snapshot: &SnapshotOptions,
    path: &Path,
) -> Result<(), SnapshotError> {
    use crate::render::{RenderCamera, RenderOptions, Shading, render_image};
    let SnapshotOptions { viewport, look, .. } = snapshot;
    let model = session.model().ok_or(SnapshotError::NoMesh)?.clone();
    let pose = RenderCamera {
        eye: camera.eye,
        rotation: camera.orientation,
        projection: camera.projection,
        near: camera.near,
    };
    let options = RenderOptions {
        shading: if look.flat { Shading::Flat } else { Shading::Smooth },
        wireframe: look.wireframe,
        refinement_colors: look.refinement_colors,
        occlusion: look.occlusion,
        vertex_colors: model.has_colors,
        crease_angle_deg: model.crease_angle_deg,
        ..RenderOptions::default()
    };
    let replica = session.replica_mut().ok_or(SnapshotError::NoMesh)?;
    let image = render_image(replica, &model.lattice, &pose, [viewport.width_px, viewport.height_px], &options)?;
    write_aside(path, |out| image.encode_png(out).map_err(std::io::Error::other))?;
    Ok(())
}

#[cfg(not(feature = "render"))]
fn render_png(_: &mut ClientSession, _: &Camera, _: &SnapshotOptions, _: &Path) -> Result<(), SnapshotError> {
    Err(SnapshotError::NoRenderer)
}

/// What streaming left behind.
struct Streamed {
    session: ClientSession,
    /// `None` until the model is known, unless the caller named the pose.
    camera: Option<Camera>,
    elapsed: Timestamp,
}

async fn stream(options: &SnapshotOptions) -> Result<Streamed, SnapshotError> {
    let mut session = ClientSession::new(ClientConfig {
        triangle_limit: options.detail.triangle_limit,
        reconnect_seed: fastrand::u64(..),
        ..ClientConfig::default()
    });
    let mut connection = Connection::open(&options.target, options.shape).await?;
    // A pose in hand goes out with the hello; framing the model has to wait for the welcome.
    let mut camera = options.pose.map(|(eye, target)| {
        let mut camera = Camera::perspective(options.fov_y_rad);
        camera.look_at(eye, target);
        camera
    });
    let mut progress = Progress::new();
    let tick = |session: &mut ClientSession, now: Timestamp| -> Result<(), ViewError> {
        if session.view().is_none() {
            let framed = |model: &ModelInfo| Camera::frame_model(model, options.fov_y_rad, options.viewport.aspect());
            camera = camera.or_else(|| session.model().map(framed));
            if let Some(camera) = &camera {
                session.set_view(now, camera.view(options.viewport, &options.detail))?;
            }
        }
        progress.show(now, session.stats());
        Ok(())
    };
    let way_back = WayBack { target: &options.target, patience: options.reconnect_for };
    let result = drive(&mut connection, &mut session, options.until, way_back, tick).await;
    progress.clear();
    let elapsed = connection.now();
    match result {
        Ok(()) => connection.close(CloseCode::Normal).await,
        Err(DriveError::Session(ClientError::InboxFull)) => connection.close(CloseCode::Internal).await,
        Err(DriveError::Session(_)) => connection.close(CloseCode::Malformed).await,
        Err(_) => {}
    }
    result?;
    Ok(Streamed { session, camera, elapsed })
}

fn outcome(options: &SnapshotOptions, session: &ClientSession, elapsed: Timestamp) -> Outcome {
    let model = session.model();
    Outcome {
        model: options.target.model.clone(),
        title: model.map_or(String::new(), |model| model.title.clone()),
        model_triangles: model.map_or(0, |model| model.triangles),
        model_vertices: model.map_or(0, |model| model.vertices),
        elapsed_ms: elapsed.0.as_secs_f64() * 1e3,
        stats: session.stats().clone(),
    }
}

impl fmt::Display for Outcome {
    /// A summary for people.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { stats, .. } = self;
        let title: String = self.title.chars().filter(|c| !c.is_control()).collect();
        writeln!(f, "model       {} {title}", self.model)?;
        writeln!(
            f,
            "triangles   {} of {} (at most {})",
            stats.triangles, self.model_triangles, stats.max_triangles_seen
        )?;
        writeln!(f, "vertices    {} of {}", stats.vertices, self.model_vertices)?;
        let error = stats.error_px.map_or("unknown".into(), |error| format!("{error:.3} px"));
        let state = match (stats.settled, stats.limited) {
            (true, false) => "settled",
            (true, true) => "settled at the triangle limit",
            (false, _) => "not settled",
        };
        writeln!(f, "error       {error}, {state}")?;
        writeln!(f, "received    {} in {} frames", kilobytes(stats.bytes_received), stats.frames)?;
        writeln!(f, "sent        {}", kilobytes(stats.bytes_sent))?;
        let (splits, cached) = (stats.splits, stats.cached_splits);
        writeln!(f, "ops         {splits} splits ({cached} cached), {} collapses", stats.collapses)?;
        if stats.splits > 0 {
            writeln!(f, "per split   {:.1} bits", stats.bytes_received as f64 * 8.0 / stats.splits as f64)?;
        }
        let first = stats.first_image_ms.zip(stats.first_image_bytes);
        let first = first.map_or("none".into(), |(ms, bytes)| format!("{ms:.0} ms, {}", kilobytes(bytes)));
        writeln!(f, "first image {first}")?;
        if stats.connections_lost > 0 {
            let (resumed, restarted) = (stats.resumed, stats.restarted);
            writeln!(f, "broken      {} times: {resumed} resumed, {restarted} begun anew", stats.connections_lost)?;
        }
        if stats.resets > 0 {
            writeln!(f, "resets      {}", stats.resets)?;
        }
        write!(f, "elapsed     {:.0} ms", self.elapsed_ms)
    }
}

fn kilobytes(bytes: u64) -> String {
    format!("{:.1} KB", bytes as f64 / 1000.0)
}

/// A line on the terminal that is written again and again.
struct Progress {
    is_terminal: bool,
    shown_at: Option<Timestamp>,
}

impl Progress {
    fn new() -> Self {
        Self { is_terminal: io::stderr().is_terminal(), shown_at: None }
    }

    fn show(&mut self, now: Timestamp, stats: &Stats) {
        if !self.is_terminal || self.shown_at.is_some_and(|at| now.since(at) < PROGRESS_INTERVAL) {
            return;
        }
        self.shown_at = Some(now);
        let error = stats.error_px.map_or("-".into(), |error| format!("{error:.2}"));
        let received = kilobytes(stats.bytes_received);
        // A terminal that went away is no reason to stop.
        let _ = write!(io::stderr(), "\r{} triangles, {error} px, {received}\x1b[K", stats.triangles);
    }

    fn clear(&mut self) {
        if self.shown_at.take().is_some() {
            let _ = write!(io::stderr(), "\r\x1b[K");
        }
    }
}

#[cfg(test)]
mod tests;
