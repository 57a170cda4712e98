//! The viewer without a window: what a person does goes in, images to draw and frames to send come out, time is an argument.
//!
//! A [`Viewer`] owns the session with the server, the camera and its [`Navigator`], the settings and the state. It knows
//! neither sockets nor windows nor the GPU: the browser and the native window drive it, and so do tests.
//!
//! A driver opens and closes connections as [`poll_request`](Viewer::poll_request) says, hands in what they bring, sends what
//! [`poll_transmit`](Viewer::poll_transmit) returns, and calls [`tick`](Viewer::tick) before each image that it may draw. When
//! that asks for an image, it draws [`scene`](Viewer::scene) and calls [`note_drawn`](Viewer::note_drawn).
//!
//! A lost connection is opened again by itself and the session goes on; where it cannot, the picture stays until the new mesh is as
//! good. All of that is the session's ([`crate::core`]); [`line`] adds what a person is told and what is not worth a try.

pub mod command;
mod cover;
pub mod figures;
pub mod governor;
mod input;
mod keys;
mod line;
mod measure;
pub mod permalink;
pub mod pick;
mod probe;
mod recorder;
mod request;
pub mod settings;
pub mod state;
mod stream;

use std::collections::VecDeque;
use std::time::Duration;

use glam::DVec3;
use lodestream_protocol::mesh::Replica;
use lodestream_protocol::message::ModelInfo;
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::time::Timestamp;

use crate::camera::gesture::Pointers;
use crate::camera::navigate::Navigator;
use crate::camera::{Bounds, Camera, Viewport, fov_of};
use crate::core::{ClientConfig, ClientSession};
use crate::render::ghosts::MOST_GHOST_BYTES;
use crate::render::upload::Allowance;
use crate::render::{DrawStats, RenderCamera, RenderOptions};
use command::{Command, Event, Tool};
use cover::Cover;
use figures::{Figures, Meter};
use governor::{AUTO_IMAGES_PER_S, Governor};
pub use line::Ending;
use line::Line;
pub use measure::Mark;
use permalink::LinkedPose;
use probe::Probe;
use recorder::{Player, Recorder};
pub use request::Automatic;
use settings::Settings;
use state::{Progress, State};

/// Opening angle of the image's narrower side unless someone says otherwise: that of `snapshot`.
pub const FOV_RAD: f32 = std::f32::consts::FRAC_PI_4;
/// Bytes of the GPU's buffers per slot (two triangles): vertices, corners, links and normals.
const GPU_BYTES_PER_SLOT: u64 = 16 + 24 + 28 + 32 + 24;
/// Most events that wait to be fetched.
const MAX_EVENTS: usize = 64;

/// A connection of the viewer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wire {
    /// The one that shows the model.
    Main,
    /// The one that answers picks.
    Probe,
}

/// What the driver is to do with a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// Open it; an open one of this kind is closed before.
    Open(Wire),
    /// Close it. Nothing of it may be handed in afterwards.
    Close(Wire),
}

/// What is known of a model before the server's welcome.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hint {
    /// The ball around it.
    pub bounds: Bounds,
    /// Least triangle limit.
    pub smallest_limit: u32,
}

/// How a viewer begins.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewerOptions {
    /// Pixels of the image.
    pub viewport: Viewport,
    /// Pixels of the image per point of the screen.
    pub pixels_per_point: f64,
    /// Automatic triangle limit; the rate of images may lower it.
    pub auto_triangles: u32,
    /// Automatic limit of memory, in MiB.
    pub auto_memory_mib: u32,
    /// Bytes that may be uploaded for one image.
    pub upload_allowance: u64,
    /// Whether the machine draws fast enough that automatic shading need not spare it.
    pub spend: bool,
    /// Whether something lies over the image until [`Viewer::uncover`]: the picture of a page.
    pub is_covered: bool,
    /// The model, if something is known of it.
    pub hint: Option<Hint>,
    /// Fragment of a link.
    pub link: String,
    /// Spreads attempts to connect over time.
    pub seed: u64,
}

impl ViewerOptions {
    /// A desktop's.
    pub fn new(viewport: Viewport) -> Self {
        Self {
            viewport,
            pixels_per_point: 1.0,
            auto_triangles: 1_000_000,
            auto_memory_mib: 1024,
            upload_allowance: 2 << 20,
            spend: true,
            is_covered: false,
            hint: None,
            link: String::new(),
            seed: 1,
        }
    }
}

/// What a tick asks for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tick {
    /// Draw an image now.
    pub draw: bool,
    /// Call again at once (`Some` of a time not after now), at that time, or when something happens.
    pub wake: Option<Timestamp>,
}

/// What to draw.
pub struct Scene<'a> {
    /// The mesh.
    pub replica: &'a mut Replica,
    /// Its lattice.
    pub lattice: Lattice,
    /// From where.
    pub camera: RenderCamera,
    /// How.
    pub options: RenderOptions,
}

/// See the module.
#[derive(Debug)]
pub struct Viewer {
    options: ViewerOptions,
    settings: Settings,
    navigator: Option<Navigator>,
    pointers: Pointers,
    tool: Tool,
    /// Keys held that move the camera, with what they do.
    held: Vec<(String, DVec3)>,
    linked: Option<LinkedPose>,
    /// Point under the cursor: where that is, when it was found.
    anchor: Option<([f64; 2], Timestamp, DVec3)>,
    line: Line,
    session: ClientSession,
    probe: Option<(Probe, bool)>,
    requests: VecDeque<Request>,
    /// The camera that views are asked for, where that is not the one that looks.
    frozen: Option<Camera>,
    marks: Vec<Mark>,
    next_mark: u32,
    recorder: Option<Recorder>,
    player: Option<Player>,
    events: VecDeque<Event>,
    governor: Governor,
    progress: Progress,
    state: State,
    figures: Figures,
    received: Meter,
    images: Meter,
    allowance: Allowance,
    sent_bytes: u64,
    received_bytes: u64,
    needs_image: bool,
    /// Ops applied since the last image.
    ops_since_image: u32,
    /// The next image uploads the mesh whole.
    is_whole: bool,
    cover: Cover,
    last_image: Option<Timestamp>,
    /// Which of the session's meshes the last image showed.
    drawn_generation: Option<u32>,
    memory_of_program: Option<u64>,
}

impl Viewer {
    /// A viewer that wants to connect.
    pub fn new(options: ViewerOptions) -> Self {
        let (linked, settings) = permalink::read(&options.link, FOV_RAD);
        let mut viewer = Self {
            pointers: Pointers::new(options.pixels_per_point),
            line: Line::new(),
            session: ClientSession::new(ClientConfig::default()),
            governor: Governor::new(options.auto_triangles),
            settings,
            linked,
            navigator: None,
            tool: Tool::Look,
            held: Vec::new(),
            anchor: None,
            probe: None,
            requests: VecDeque::new(),
            frozen: None,
            marks: Vec::new(),
            next_mark: 0,
            recorder: None,
            player: None,
            events: VecDeque::new(),
            progress: Progress::default(),
            state: State::Connecting,
            figures: Figures::default(),
            received: Meter::default(),
            images: Meter::default(),
            // Ghosts are of what goes, which is not known before.
            allowance: Allowance::new(options.upload_allowance.saturating_sub(MOST_GHOST_BYTES)),
            sent_bytes: 0,
            received_bytes: 0,
            needs_image: true,
            ops_since_image: 0,
            is_whole: false,
            cover: if options.is_covered { Cover::On } else { Cover::Off },
            last_image: None,
            drawn_generation: None,
            memory_of_program: None,
            options,
        };
        viewer.session = ClientSession::new(viewer.session_config());
        if let Some(hint) = viewer.options.hint {
            viewer.begin_navigation(hint.bounds);
        }
        viewer
    }

    /// What to do about connections next.
    pub fn poll_request(&mut self) -> Option<Request> {
        self.requests.pop_front()
    }

    /// The image has another size.
    pub fn resize(&mut self, viewport: Viewport, pixels_per_point: f64) {
        self.options.viewport = viewport;
        self.options.pixels_per_point = pixels_per_point;
        self.pointers.set_pixels_per_point(pixels_per_point);
        if let Some(navigator) = &mut self.navigator {
            navigator.set_viewport(viewport);
        }
        self.needs_image = true;
    }

    /// Does what a command says. What cannot be done becomes an [`Event::Notice`].
    pub fn command(&mut self, now: Timestamp, command: Command) {
        self.needs_image = true;
        match command {
            Command::Set { key, value } => self.set(now, &key, &value),
            Command::Tool(tool) => self.tool = tool,
            Command::Pick(at_px) => self.pick(now, at_px),
            Command::Freeze(is_on) => {
                let camera = self.navigator.as_ref().map(Navigator::camera);
                self.frozen = camera.filter(|_| is_on);
            }
            Command::ClearMarks => self.marks.clear(),
            Command::Open(link) => self.open_link(now, &link),
            Command::Record => self.recorder = Some(Recorder::new(now)),
            Command::StopRecording => {
                if let Some(recorder) = self.recorder.take() {
                    let file = recorder.finish(now, self.navigator.as_ref(), self.tolerance_px());
                    self.notify(Event::Recorded(file));
                }
            }
            Command::Play(file) => match Player::new(now, &file) {
                Ok(player) => self.player = Some(player),
                Err(error) => self.notify(Event::Notice(format!("this recording cannot be played: {error}"))),
            },
            Command::StopPlaying => self.stop_player(),
            Command::Focus(at_px) => {
                if let Some(hit) = self.surface_at(at_px)
                    && let Some(navigator) = &mut self.navigator
                {
                    navigator.focus(now, hit);
                }
            }
            Command::View(_) | Command::Fit | Command::Orthographic(_) | Command::Up(_) => {
                self.stop_player();
                let Some(navigator) = &mut self.navigator else { return };
                match command {
                    Command::View(view) => navigator.standard(now, view),
                    Command::Orthographic(is_on) => navigator.set_orthographic(is_on),
                    Command::Up(axis) => navigator.set_up(now, axis),
                    _ => navigator.fit(now),
                }
            }
        }
    }

    /// Goes on to `now`: moves the camera, applies what arrived as far as the allowance goes, says whether to draw.
    pub fn tick(&mut self, now: Timestamp) -> Tick {
        if self.line.poll_open(now, &mut self.session) {
            self.requests.push_back(Request::Open(Wire::Main));
        }
        self.apply(now);
        self.tick_probe(now);
        if self.navigator.is_none()
            && let Some(model) = self.session.model()
        {
            let bounds = Bounds::of(model);
            self.begin_navigation(bounds);
        }
        let mut moved = false;
        if let Some(navigator) = &mut self.navigator {
            if let Some(player) = &mut self.player {
                let (orbit, fov_y_rad, is_last) = player.pose(now);
                navigator.set_pose(orbit, fov_of(fov_y_rad, self.options.viewport.aspect()), false);
                if is_last {
                    self.player = None;
                    self.events.push_back(Event::Played);
                }
            }
            moved = navigator.advance(now);
        }
        let tolerance_px = self.tolerance_px();
        if moved && let Some((recorder, navigator)) = self.recorder.as_mut().zip(self.navigator.as_ref()) {
            recorder.note(now, navigator, tolerance_px);
        }
        self.update_view(now);
        self.update_state();
        self.needs_image |= moved || self.is_dirty();
        let due = self.last_image.and_then(|last| {
            let per_s = self.settings.images_per_s.fixed()?;
            // A little early, or every other image of the screen would be missed.
            Some(last + Duration::from_secs_f32(0.9 / per_s))
        });
        let draw = self.needs_image && self.replica().is_some() && due.is_none_or(|due| due <= now);
        Tick { draw, wake: self.wake(now, due) }
    }

    /// What to draw, if there is a mesh.
    pub fn scene(&mut self, now: Timestamp) -> Option<Scene<'_>> {
        let camera = self.navigator.as_ref()?.camera();
        let options = {
            let model = self.session.model()?;
            let section = self.clip_planes().first().copied();
            let mut options =
                self.settings.render_options(model.has_colors, model.crease_angle_deg, section, self.options.spend);
            options.occlusion *= self.cover.crevices(now);
            options.geomorph = self.settings.morph.fixed().unwrap_or(true).then_some(now.0);
            options
        };
        let generation = self.session.generation();
        let lattice = self.session.model()?.lattice;
        let replica = self.session.replica_mut()?;
        if self.drawn_generation != Some(generation) {
            // Another mesh than the last image's: whoever follows it begins anew.
            self.drawn_generation = Some(generation);
            self.is_whole = true;
            replica.track_dirty();
        }
        let camera = render_camera(&camera);
        Some(Scene { replica, lattice, camera, options })
    }

    /// The scene was drawn.
    pub fn note_drawn(&mut self, now: Timestamp, stats: &DrawStats) {
        // Vertices on their way go on in the next image, and so do crevices that grow dark.
        self.needs_image = stats.is_moving || (self.cover.is_going(now) && stats.has_occlusion);
        self.last_image = Some(now);
        self.images.add(now, 1.0);
        let triangles = self.replica().map_or(0, Replica::triangle_count);
        self.figures.uploaded_bytes = stats.uploaded_bytes;
        if !std::mem::take(&mut self.is_whole) {
            self.figures.most_uploaded_bytes = self.figures.most_uploaded_bytes.max(stats.uploaded_bytes);
            self.figures.images_over_allowance += u32::from(stats.uploaded_bytes > self.options.upload_allowance);
        }
        self.figures.applied_ops = std::mem::take(&mut self.ops_since_image);
        self.figures.most_applied_ops = self.figures.most_applied_ops.max(self.figures.applied_ops);
        let wanted = self.settings.images_per_s.fixed().unwrap_or(AUTO_IMAGES_PER_S);
        let in_motion = self.is_moving();
        self.governor.note_image(now, in_motion, triangles, wanted);
    }

    /// What lay over the image goes.
    pub fn uncover(&mut self, now: Timestamp) {
        if self.cover == Cover::On {
            self.cover = Cover::Going(now);
            self.needs_image = true;
        }
    }

    /// Draw again although nothing changed: the picture was lost.
    pub fn redraw(&mut self) {
        self.needs_image = true;
        self.drawn_generation = None;
    }

    /// The state, after the last [`tick`](Self::tick).
    pub fn state(&self) -> &State {
        &self.state
    }

    /// The figures.
    pub fn figures(&mut self, now: Timestamp) -> Figures {
        let (bytes_per_s, images_per_s) = (self.received.per_second(now), self.images.per_second(now));
        let (stats, shown) = (self.session.stats(), self.replica());
        let slots = shown.map_or(0, |replica| u64::from(replica.slot_end()).next_power_of_two());
        let heap = shown.map_or(0, |replica| replica.heap_bytes() as u64);
        let (splits, cached) = (stats.splits, stats.cached_splits);
        Figures {
            triangles: shown.map_or(0, Replica::triangle_count),
            limit: self.triangle_limit(),
            model_triangles: self.model().map_or(0, |model| model.triangles),
            // Before that it is only what was asked for.
            error_px: stats.error_px.filter(|_| stats.settled),
            bytes_per_s,
            round_trip_ms: stats.view_latency_ms.or(self.figures.round_trip_ms),
            images_per_s,
            cache_hits: (splits > 0).then(|| cached as f64 / splits as f64),
            memory_bytes: self.memory_of_program.unwrap_or(heap) + slots * GPU_BYTES_PER_SLOT,
            views: stats.views,
            ..self.figures
        }
    }

    /// All memory that the program holds, where that is known better than by adding up the mesh.
    pub fn set_memory_of_program(&mut self, bytes: u64) {
        self.memory_of_program = Some(bytes);
    }

    /// What happened, oldest first.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// The settings.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// What a tap does.
    pub fn tool(&self) -> Tool {
        self.tool
    }

    /// Whether views are being recorded.
    pub fn is_recording(&self) -> bool {
        self.recorder.is_some()
    }

    /// Whether a recording is being played.
    pub fn is_playing(&self) -> bool {
        self.player.is_some()
    }

    /// Camera control, once the model is known.
    pub fn navigator(&self) -> Option<&Navigator> {
        self.navigator.as_ref()
    }

    /// What the server says about the model.
    pub fn model(&self) -> Option<&ModelInfo> {
        self.session.model()
    }

    /// The mesh on screen.
    pub fn replica(&self) -> Option<&Replica> {
        self.session.replica()
    }

    /// Whether the view that is asked for stays while the camera moves.
    pub fn is_frozen(&self) -> bool {
        self.frozen.is_some()
    }

    /// Fragment of a link to this view.
    pub fn link(&self) -> Option<String> {
        Some(permalink::write(self.navigator.as_ref()?, &self.settings, FOV_RAD))
    }

    fn begin_navigation(&mut self, bounds: Bounds) {
        let mut navigator = Navigator::new(bounds, self.options.viewport, FOV_RAD);
        if let Some(pose) = self.linked.take() {
            navigator.set_pose(pose.orbit, pose.fov_rad, pose.is_orthographic);
        }
        self.navigator = Some(navigator);
    }

    fn stop_player(&mut self) {
        if self.player.take().is_some() {
            self.notify(Event::Played);
        }
    }

    fn notify(&mut self, event: Event) {
        if self.events.len() < MAX_EVENTS {
            self.events.push_back(event);
        }
    }

    fn is_moving(&self) -> bool {
        self.player.is_some() || self.navigator.as_ref().is_some_and(Navigator::is_moving)
    }
}

/// A camera in the renderer's terms.
fn render_camera(camera: &Camera) -> RenderCamera {
    RenderCamera { eye: camera.eye, rotation: camera.orientation, projection: camera.projection, near: camera.near }
}

fn with_causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

#[cfg(test)]
mod tests;
