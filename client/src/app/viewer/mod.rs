//! The viewer without a window: what a person does goes in, images to draw and frames to send come out, time is an argument.
//!
//! A [`Viewer`] owns the session with the server, the camera and its [`Navigator`], the settings and the state. It knows
//! neither sockets nor windows nor the GPU: the browser and the native window drive it, and so do tests.
//!
//! A driver opens and closes connections as [`poll_request`](Viewer::poll_request) says, hands in what they bring, sends what
//! [`poll_transmit`](Viewer::poll_transmit) returns, and calls [`tick`](Viewer::tick) before each image that it may draw. When
//! that asks for an image, it draws [`scene`](Viewer::scene) and calls [`note_drawn`](Viewer::note_drawn).
//!
//! A lost connection is opened again by itself, and the picture stays until the new mesh is as good.

pub mod command;
mod connection;
pub mod figures;
pub mod governor;
mod keys;
pub mod permalink;
pub mod pick;
mod probe;
mod recorder;
pub mod settings;
pub mod state;

use std::collections::VecDeque;
use std::time::Duration;

use glam::DVec3;
use lodestream_protocol::mesh::Replica;
use lodestream_protocol::message::ModelInfo;
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::View;

use crate::camera::gesture::{Gesture, Pointers, Press};
use crate::camera::navigate::Navigator;
use crate::camera::{Bounds, Camera, Detail, Viewport};
use crate::core::{ClientConfig, ClientSession};
use crate::render::lines::frustum;
use crate::render::upload::{Allowance, planned_bytes};
use crate::render::{DrawStats, Line, RenderCamera, RenderOptions};
use command::{Command, Event, Tool};
use connection::Connection;
pub use connection::Ending;
use connection::Phase;
use figures::{Figures, Meter};
use governor::{AUTO_IMAGES_PER_S, Governor};
use keys::KeyAction;
use permalink::LinkedPose;
use probe::{Probe, Question};
use recorder::{Player, Recorder};
use settings::{Auto, Settings};
use state::{Progress, State};

/// Vertical opening angle unless someone says otherwise: that of `snapshot`.
pub const FOV_Y_RAD: f32 = std::f32::consts::FRAC_PI_4;
/// Bytes that a triangle takes: mesh and cache in memory, buffers of the GPU. Measured at 1 M triangles, rounded up.
const BYTES_PER_TRIANGLE: u64 = 160;
/// Bytes of the GPU's buffers per slot (two triangles): vertices, corners, links and normals.
const GPU_BYTES_PER_SLOT: u64 = 16 + 24 + 28 + 32 + 24;
/// Pixels of a wheel for a factor e.
const WHEEL_PX: f64 = 500.0;
/// How long a point under a resting cursor is good for.
const ANCHOR_KEPT: Duration = Duration::from_millis(400);
/// Colour of marks, in sRGB.
const MARK_COLOR: [u8; 3] = [0xff, 0xb0, 0x20];
/// Most events that wait to be fetched.
const MAX_EVENTS: usize = 64;
/// Bytes of ops that may wait to be applied: more than a server sends without acknowledgement.
const INBOX_BYTES: usize = 16 << 20;

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

/// A point on the surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// In model units.
    pub point: DVec3,
    /// Whether it lies on the complete model, not just on what is on screen.
    pub is_exact: bool,
    id: u32,
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
    connection: Connection,
    session: ClientSession,
    /// The mesh of a connection before, as long as it is better.
    kept: Option<ClientSession>,
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
    last_image: Option<Timestamp>,
    drawn_generation: Option<(bool, u32)>,
    memory_of_program: Option<u64>,
}

impl Viewer {
    /// A viewer that wants to connect.
    pub fn new(now: Timestamp, options: ViewerOptions) -> Self {
        let (linked, settings) = permalink::read(&options.link, FOV_Y_RAD);
        let mut viewer = Self {
            pointers: Pointers::new(options.pixels_per_point),
            connection: Connection::new(now, options.seed),
            session: ClientSession::new(ClientConfig::default()),
            governor: Governor::new(options.auto_triangles),
            settings,
            linked,
            navigator: None,
            tool: Tool::Look,
            held: Vec::new(),
            anchor: None,
            kept: None,
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
            allowance: Allowance::new(options.upload_allowance),
            sent_bytes: 0,
            received_bytes: 0,
            needs_image: true,
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

    /// Takes a connection that was opened, and on which this hello was sent, before the viewer was there. `false` if the
    /// viewer would have said something else: that connection is of no use then.
    pub fn adopt(&mut self, now: Timestamp, hello: &[u8]) -> bool {
        let mut session = ClientSession::new(self.session_config());
        if session.poll_transmit(now).as_deref() != Some(hello) || !self.connection.poll_open(now) {
            return false;
        }
        self.session = session;
        self.sent_bytes = hello.len() as u64;
        self.connection.handle_open(now);
        true
    }

    /// What to do about connections next.
    pub fn poll_request(&mut self) -> Option<Request> {
        self.requests.pop_front()
    }

    /// A connection is open.
    pub fn handle_open(&mut self, now: Timestamp, wire: Wire) {
        match (wire, &mut self.probe) {
            (Wire::Main, _) => {
                self.restart_session();
                self.connection.handle_open(now);
            }
            (Wire::Probe, Some((_, is_open))) => *is_open = true,
            (Wire::Probe, None) => self.requests.push_back(Request::Close(Wire::Probe)),
        }
    }

    /// A connection brought a frame.
    pub fn handle_frame(&mut self, now: Timestamp, wire: Wire, frame: &[u8]) {
        // The head of a frame of WebSocket, as servers send it.
        let bytes = frame.len() as u64 + if frame.len() < 126 { 2 } else { 4 };
        self.received.add(now, bytes as f64);
        self.figures.bytes_received += bytes;
        match wire {
            Wire::Main => {
                self.received_bytes += bytes;
                self.session.note_traffic(self.received_bytes, self.sent_bytes);
                if let Err(error) = self.session.handle_frame(now, frame) {
                    self.requests.push_back(Request::Close(Wire::Main));
                    self.keep_mesh();
                    self.connection.note_fault(now, &with_causes(&error));
                }
            }
            Wire::Probe => {
                if let Some((probe, _)) = &mut self.probe
                    && probe.session_mut().handle_frame(now, frame).is_err()
                {
                    self.end_probe();
                }
            }
        }
    }

    /// A connection ended, or could not be opened.
    pub fn handle_end(&mut self, now: Timestamp, wire: Wire, ending: &Ending) {
        match wire {
            Wire::Main => {
                let had_mesh = self.session.replica().is_some();
                self.keep_mesh();
                self.connection.handle_end(now, ending, had_mesh);
            }
            Wire::Probe => self.end_probe(),
        }
    }

    /// The next frame to send.
    pub fn poll_transmit(&mut self, now: Timestamp) -> Option<(Wire, Vec<u8>)> {
        if matches!(self.connection.phase, Phase::Open { .. })
            && let Some(frame) = self.session.poll_transmit(now)
        {
            self.sent_bytes += frame.len() as u64;
            return Some((Wire::Main, frame));
        }
        let (probe, is_open) = self.probe.as_mut()?;
        let frame = is_open.then(|| probe.session_mut().poll_transmit(now))??;
        Some((Wire::Probe, frame))
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

    /// A pointer goes down, at pixels of the image.
    pub fn press(&mut self, now: Timestamp, id: i32, press: Press, at_px: [f64; 2]) {
        self.stop_player();
        if let Some(navigator) = &mut self.navigator {
            navigator.stop();
        }
        self.pointers.press(now, id, press, at_px);
    }

    /// A pointer moves.
    pub fn motion(&mut self, now: Timestamp, id: i32, at_px: [f64; 2]) {
        for gesture in self.pointers.motion(id, at_px) {
            self.handle_gesture(now, gesture);
        }
    }

    /// A pointer goes up.
    pub fn release(&mut self, now: Timestamp, id: i32) {
        if let Some(gesture) = self.pointers.release(now, id) {
            self.handle_gesture(now, gesture);
        }
    }

    /// Pointers and keys are lost: another window has them.
    pub fn cancel(&mut self, now: Timestamp) {
        self.pointers.cancel();
        self.held.clear();
        self.apply_thrust(now);
    }

    /// A wheel turned by so many pixels, positive towards the person, who moves away then.
    pub fn wheel(&mut self, now: Timestamp, at_px: [f64; 2], down_px: f64) {
        self.stop_player();
        let anchor = self.anchor(now, at_px);
        if let Some((navigator, anchor)) = self.navigator.as_mut().zip(anchor) {
            navigator.zoom(now, anchor, (down_px.clamp(-1000.0, 1000.0) / WHEEL_PX).exp());
        }
    }

    /// A key goes down or up, by its name in browsers (`KeyboardEvent.code`). Says whether it means something here.
    pub fn key(&mut self, now: Timestamp, code: &str, is_down: bool, shift: bool) -> bool {
        let Some(action) = keys::action(code, shift) else { return false };
        if let KeyAction::Thrust(direction) = action {
            self.held.retain(|(held, _)| held != code);
            if is_down {
                self.stop_player();
                self.held.push((code.to_owned(), direction));
            }
            self.apply_thrust(now);
            return true;
        }
        if !is_down {
            return true;
        }
        let step = self.options.pixels_per_point;
        match action {
            KeyAction::Do(command) => self.command(now, command),
            KeyAction::ToggleOrthographic => {
                let is_on = self.navigator.as_ref().is_some_and(Navigator::is_orthographic);
                self.command(now, Command::Orthographic(!is_on));
            }
            KeyAction::ToggleFrozen => self.command(now, Command::Freeze(self.frozen.is_none())),
            KeyAction::Toggle(tool) => {
                self.command(now, Command::Tool(if self.tool == tool { Tool::Look } else { tool }));
            }
            KeyAction::Turn([x, y]) => self.handle_gesture(now, Gesture::Turn { by_px: [x * step, y * step] }),
            KeyAction::Pan([x, y]) => self.handle_gesture(now, Gesture::Pan { by_px: [x * step, y * step] }),
            KeyAction::Zoom(factor) => {
                if let Some(navigator) = &mut self.navigator {
                    let target = navigator.orbit().target;
                    navigator.zoom(now, target, factor);
                }
            }
            KeyAction::Thrust(_) => unreachable!("handled above"),
        }
        true
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
        if self.connection.poll_open(now) {
            self.keep_mesh();
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
                let (orbit, fov, is_last) = player.pose(now);
                navigator.set_pose(orbit, fov, false);
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
        let draw = self.needs_image && self.shown().is_some() && due.is_none_or(|due| due <= now);
        Tick { draw, wake: self.wake(now, due) }
    }

    /// What to draw, if there is a mesh.
    pub fn scene(&mut self, now: Timestamp) -> Option<Scene<'_>> {
        let camera = self.navigator.as_ref()?.camera();
        let is_kept = self.kept.is_some();
        let options = {
            let model = self.shown()?.model()?;
            let section = self.clip_planes().first().copied();
            let mut options =
                self.settings.render_options(model.has_colors, model.crease_angle_deg, section, self.options.spend);
            options.geomorph = self.settings.morph.fixed().unwrap_or(true).then_some(now.0);
            options
        };
        let session = self.kept.as_mut().unwrap_or(&mut self.session);
        let generation = session.generation();
        let lattice = session.model()?.lattice;
        let replica = session.replica_mut()?;
        if self.drawn_generation != Some((is_kept, generation)) {
            // Another mesh than the last image's: whoever follows it begins anew.
            self.drawn_generation = Some((is_kept, generation));
            replica.track_dirty();
        }
        let camera = render_camera(&camera);
        Some(Scene { replica, lattice, camera, options })
    }

    /// The scene was drawn.
    pub fn note_drawn(&mut self, now: Timestamp, stats: &DrawStats) {
        // Vertices on their way go on in the next image.
        self.needs_image = stats.is_moving;
        self.last_image = Some(now);
        self.images.add(now, 1.0);
        let triangles = self.shown().map_or(0, |session| session.stats().triangles);
        self.figures.uploaded_bytes = stats.uploaded_bytes;
        self.figures.most_uploaded_bytes = self.figures.most_uploaded_bytes.max(stats.uploaded_bytes);
        let wanted = self.settings.images_per_s.fixed().unwrap_or(AUTO_IMAGES_PER_S);
        let in_motion = self.is_moving();
        self.governor.note_image(now, in_motion, triangles, wanted);
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
        let shown = self.kept.as_ref().unwrap_or(&self.session);
        let (stats, model) = (shown.stats(), shown.model());
        let slots = shown.replica().map_or(0, |replica| u64::from(replica.slot_end()).next_power_of_two());
        let heap = shown.replica().map_or(0, |replica| replica.heap_bytes() as u64);
        let (splits, cached) = (self.session.stats().splits, self.session.stats().cached_splits);
        Figures {
            triangles: stats.triangles,
            limit: self.triangle_limit(),
            model_triangles: model.map_or(0, |model| model.triangles),
            // Before that it is only what was asked for.
            error_px: stats.error_px.filter(|_| stats.settled),
            bytes_per_s: self.received.per_second(now),
            round_trip_ms: self.session.stats().view_latency_ms.or(self.figures.round_trip_ms),
            images_per_s: self.images.per_second(now),
            cache_hits: (splits > 0).then(|| cached as f64 / splits as f64),
            memory_bytes: self.memory_of_program.unwrap_or(heap) + slots * GPU_BYTES_PER_SLOT,
            views: self.session.stats().views,
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
        self.shown()?.model()
    }

    /// The mesh on screen.
    pub fn replica(&self) -> Option<&Replica> {
        self.shown()?.replica()
    }

    /// The line between the marks and the edges of a frozen view, to be drawn on top of the mesh.
    pub fn lines(&self) -> Vec<Line> {
        let mut lines = match self.marks[..] {
            [a, b] => vec![Line { from: a.point, to: b.point, color: MARK_COLOR }],
            _ => Vec::new(),
        };
        if let Some((camera, model)) = self.frozen.zip(self.model()) {
            let bounds = Bounds::of(model);
            let depth = (bounds.center - camera.eye).dot(camera.forward()) + bounds.radius;
            let depth = depth.max(0.1 * bounds.radius);
            lines.extend(frustum(&render_camera(&camera), self.options.viewport.aspect(), depth, MARK_COLOR));
        }
        lines
    }

    /// Whether the view that is asked for stays while the camera moves.
    pub fn is_frozen(&self) -> bool {
        self.frozen.is_some()
    }

    /// The marks, at most two.
    pub fn marks(&self) -> &[Mark] {
        &self.marks
    }

    /// The distance between the marks in model units, and whether both are exact.
    pub fn distance(&self) -> Option<(f64, bool)> {
        let [a, b] = self.marks[..] else { return None };
        Some((a.point.distance(b.point), a.is_exact && b.is_exact))
    }

    /// Where a point is in the image, if it is in front of the camera.
    pub fn pixel(&self, point: DVec3) -> Option<[f64; 2]> {
        self.navigator.as_ref()?.camera().pixel(self.options.viewport, point)
    }

    /// Fragment of a link to this view.
    pub fn link(&self) -> Option<String> {
        Some(permalink::write(self.navigator.as_ref()?, &self.settings, FOV_Y_RAD))
    }

    fn session_config(&self) -> ClientConfig {
        ClientConfig {
            triangle_limit: self.triangle_ceiling(),
            byte_rate: self.settings.byte_rate.fixed(),
            apply_on_arrival: false,
            inbox_bytes: INBOX_BYTES,
            ..ClientConfig::default()
        }
    }

    fn begin_navigation(&mut self, bounds: Bounds) {
        let mut navigator = Navigator::new(bounds, self.options.viewport, FOV_Y_RAD);
        if let Some(pose) = self.linked.take() {
            navigator.set_pose(pose.orbit, pose.fov_y_rad, pose.is_orthographic);
        }
        self.navigator = Some(navigator);
    }

    /// The mesh on screen goes on being shown until another is as good.
    fn keep_mesh(&mut self) {
        if self.session.replica().is_some() {
            let next = ClientSession::new(self.session_config());
            let ended = std::mem::replace(&mut self.session, next);
            match &self.kept {
                Some(kept) if is_better(kept, &ended) => {}
                // The picture is the same, so whoever follows the mesh goes on.
                None => {
                    self.drawn_generation = self.drawn_generation.map(|(_, generation)| (true, generation));
                    self.kept = Some(ended);
                }
                Some(_) => {
                    self.drawn_generation = None;
                    self.kept = Some(ended);
                }
            }
        }
    }

    fn restart_session(&mut self) {
        self.keep_mesh();
        self.session = ClientSession::new(self.session_config());
        (self.sent_bytes, self.received_bytes) = (0, 0);
    }

    /// The session whose mesh is on screen.
    fn shown(&self) -> Option<&ClientSession> {
        self.kept.as_ref().or_else(|| self.session.replica().map(|_| &self.session))
    }

    fn is_dirty(&mut self) -> bool {
        let is_kept = self.kept.is_some();
        let session = self.kept.as_mut().unwrap_or(&mut self.session);
        let generation = session.generation();
        let Some(replica) = session.replica_mut() else { return false };
        self.drawn_generation != Some((is_kept, generation))
            || replica.dirty_mut().is_none_or(|dirty| !dirty.is_empty())
    }

    /// Applies batches until their uploads fill the allowance. The mesh that is not on screen has no uploads, and its
    /// batches are applied in the same amounts.
    fn apply(&mut self, now: Timestamp) {
        let mut unseen = 0;
        while let Some(op_bytes) = self.session.next_op_bytes() {
            // A mesh that was never drawn is uploaded whole, whatever is applied before.
            let seen = self.planned_bytes();
            let planned = seen.unwrap_or(unseen);
            if !self.allowance.admits(planned, op_bytes) {
                break;
            }
            if let Err(error) = self.session.apply_ready(now, 1) {
                self.requests.push_back(Request::Close(Wire::Main));
                self.keep_mesh();
                self.connection.note_fault(now, &with_causes(&error));
                return;
            }
            match self.planned_bytes().filter(|_| seen.is_some()) {
                Some(after) if op_bytes > 0 => self.allowance.learn(planned, after, op_bytes),
                _ => unseen += self.allowance.estimate(op_bytes),
            }
        }
        if self.kept.as_ref().is_some_and(|kept| !is_better(kept, &self.session)) {
            self.kept = None;
            self.drawn_generation = None;
        }
    }

    /// What is to be uploaded for the mesh on screen, if that is the session's.
    fn planned_bytes(&mut self) -> Option<u64> {
        let replica = self.session.replica_mut().filter(|_| self.kept.is_none())?;
        planned_bytes(replica)
    }

    fn tick_probe(&mut self, now: Timestamp) {
        let Some((probe, _)) = &mut self.probe else { return };
        match probe.tick(now) {
            Ok(Some(answer)) => {
                if let Some(mark) = self.marks.iter_mut().find(|mark| mark.id == answer.id)
                    && let Some(hit) = answer.hit
                {
                    mark.point = hit.point;
                    mark.is_exact = answer.is_complete;
                    self.notify(Event::Marked);
                    self.needs_image = true;
                }
            }
            Ok(None) if !probe.is_over(now) => {}
            Ok(None) | Err(_) => self.end_probe(),
        }
    }

    fn end_probe(&mut self) {
        let Some((probe, _)) = self.probe.take() else { return };
        self.requests.push_back(Request::Close(Wire::Probe));
        if probe.unanswered().any(|id| self.marks.iter().any(|mark| mark.id == id)) {
            self.notify(Event::Notice(
                "the server did not refine this point: the mark is on the mesh on screen".into(),
            ));
        }
    }

    fn handle_gesture(&mut self, now: Timestamp, gesture: Gesture) {
        let is_flying = self.tool == Tool::Fly;
        let Some(navigator) = &mut self.navigator else { return };
        match gesture {
            Gesture::Turn { by_px: [x, y] } if is_flying => navigator.look(x, y),
            Gesture::Turn { by_px: [x, y] } => navigator.drag(now, x, y),
            Gesture::Release if is_flying => {}
            Gesture::Release => navigator.release(now),
            Gesture::Pan { by_px: [x, y] } => navigator.pan(x, y),
            Gesture::Pinch { center_px, factor, clockwise_rad } => {
                navigator.twist(clockwise_rad);
                if let Some(anchor) = self.anchor(now, center_px)
                    && let Some(navigator) = &mut self.navigator
                {
                    navigator.pinch(anchor, 1.0 / factor);
                }
            }
            Gesture::Tap { at_px } if self.tool == Tool::Measure => self.pick(now, at_px),
            Gesture::Tap { .. } => {}
            Gesture::DoubleTap { at_px } if self.tool == Tool::Measure => self.pick(now, at_px),
            Gesture::DoubleTap { at_px } => self.command(now, Command::Focus(at_px)),
        }
    }

    fn apply_thrust(&mut self, now: Timestamp) {
        let thrust = self.held.iter().map(|(_, direction)| *direction).sum();
        if let Some(navigator) = &mut self.navigator {
            navigator.set_thrust(now, thrust);
        }
    }

    /// The point of the surface under a pixel, or of the plane through the target where there is none.
    fn anchor(&mut self, now: Timestamp, at_px: [f64; 2]) -> Option<DVec3> {
        let reach = 8.0 * self.options.pixels_per_point;
        if let Some((where_px, when, point)) = self.anchor
            && now.since(when) < ANCHOR_KEPT
            && (0..2).all(|k| (where_px[k] - at_px[k]).abs() < reach)
        {
            self.anchor = Some((at_px, now, point));
            return Some(point);
        }
        let navigator = self.navigator.as_ref()?;
        let camera = navigator.camera();
        let point = self.surface_at(at_px).or_else(|| {
            let ray = camera.ray(self.options.viewport, at_px);
            let ahead = ray.direction.dot(camera.forward());
            let depth = (navigator.orbit().target - ray.origin).dot(camera.forward());
            (ahead > 0.0 && depth > 0.0).then(|| ray.at(depth / ahead))
        })?;
        self.anchor = Some((at_px, now, point));
        Some(point)
    }

    fn surface_at(&self, at_px: [f64; 2]) -> Option<DVec3> {
        let camera = self.navigator.as_ref()?.camera();
        let (model, replica) = (self.model()?, self.replica()?);
        let ray = camera.ray(self.options.viewport, at_px);
        pick::first_hit(replica, &model.lattice, &ray, camera.near, &self.clip_planes()).map(|hit| hit.point)
    }

    fn pick(&mut self, now: Timestamp, at_px: [f64; 2]) {
        let (Some(navigator), Some(point)) = (&self.navigator, self.surface_at(at_px)) else {
            return self.notify(Event::Notice("there is no surface there".into()));
        };
        let camera = navigator.camera();
        let ray = camera.ray(self.options.viewport, at_px);
        if self.marks.len() >= 2 {
            self.marks.clear();
        }
        self.next_mark = self.next_mark.wrapping_add(1);
        let id = self.next_mark;
        self.marks.push(Mark { point, is_exact: false, id });
        self.notify(Event::Marked);
        let Some(model) = self.model() else { return };
        let (two_sided, smallest_limit) = (model.is_open, model.smallest_limit);
        let planes = self.clip_planes();
        let question = Question { id, ray, camera, viewport: self.options.viewport, two_sided, planes };
        if self.probe.is_none() {
            self.probe = Some((Probe::new(now, smallest_limit), false));
            self.requests.push_back(Request::Open(Wire::Probe));
        }
        if let Some((probe, _)) = &mut self.probe {
            // Where too many wait, the mark stays as it is.
            let _ = probe.ask(now, question);
        }
    }

    fn set(&mut self, now: Timestamp, key: &str, value: &str) {
        let rate = self.settings.byte_rate;
        if let Err(error) = self.settings.set(key, value) {
            return self.notify(Event::Notice(error.to_string()));
        }
        if self.settings.byte_rate != rate {
            self.reconnect(now);
        }
    }

    /// The byte rate is part of the hello.
    fn reconnect(&mut self, now: Timestamp) {
        self.keep_mesh();
        self.requests.push_back(Request::Close(Wire::Main));
        self.connection.restart(now);
    }

    fn open_link(&mut self, now: Timestamp, link: &str) {
        let (pose, settings) = permalink::read(link, FOV_Y_RAD);
        let rate = std::mem::replace(&mut self.settings, settings).byte_rate;
        if rate != settings.byte_rate {
            self.reconnect(now);
        }
        match (&mut self.navigator, pose) {
            (Some(navigator), Some(pose)) => navigator.set_pose(pose.orbit, pose.fov_y_rad, pose.is_orthographic),
            (None, pose) => self.linked = pose,
            (Some(_), None) => {}
        }
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

    fn clip_planes(&self) -> Vec<[f64; 4]> {
        let Some((section, model)) = self.settings.section.zip(self.model()) else { return Vec::new() };
        let corner = |q| DVec3::from_array(model.lattice.position(q));
        vec![section.plane(corner(model.box_min), corner(model.box_max))]
    }

    /// The limit if images are quick enough: of the settings, of memory.
    fn triangle_ceiling(&self) -> u32 {
        let memory_mib = self.settings.memory_mib.fixed().unwrap_or(self.options.auto_memory_mib);
        let by_memory = (u64::from(memory_mib) << 20) / BYTES_PER_TRIANGLE;
        let by_setting = self.settings.triangles.fixed().unwrap_or(self.options.auto_triangles);
        by_setting.min(u32::try_from(by_memory).unwrap_or(u32::MAX))
    }

    /// The limit of the next view.
    fn triangle_limit(&self) -> u32 {
        let by_rate = match self.settings.triangles {
            Auto::Auto => self.governor.limit(),
            Auto::Fixed(_) => u32::MAX,
        };
        let smallest = match self.session.model() {
            Some(model) => model.smallest_limit,
            None => self.options.hint.map_or(0, |hint| hint.smallest_limit),
        };
        self.triangle_ceiling().min(by_rate).max(smallest)
    }

    fn update_view(&mut self, now: Timestamp) {
        // Without the model's smallest limit a view may be refused.
        if self.session.model().is_none() && self.options.hint.is_none() {
            return;
        }
        let Some(navigator) = &self.navigator else { return };
        let view = self.view(&self.frozen.unwrap_or_else(|| navigator.camera()));
        let before = self.session.view().map(|(seq, _)| seq);
        // A camera at the edge of what numbers can hold gives no view; the one before stays.
        if let Ok(seq) = self.session.set_view(now, view)
            && before != Some(seq)
        {
            if let Some(latency) = self.session.stats().view_latency_ms {
                self.figures.round_trip_ms = Some(latency);
            }
            self.progress.begin();
        }
    }

    fn view(&self, camera: &Camera) -> View {
        let detail = Detail {
            triangle_limit: self.triangle_limit(),
            tolerance_px: self.tolerance_px(),
            complete: false,
            two_sided: self.model().is_some_and(|model| model.is_open) || self.settings.section.is_some(),
        };
        let mut view = camera.view(self.options.viewport, &detail);
        view.clip_planes = self.clip_planes();
        view
    }

    /// Automatic: a point of the screen.
    fn tolerance_px(&self) -> f32 {
        self.settings.tolerance_px.fixed().unwrap_or(self.options.pixels_per_point.max(1.0) as f32)
    }

    fn update_state(&mut self) {
        self.state = match &self.connection.phase {
            Phase::Failed { reason } => State::Failed { reason: reason.clone() },
            Phase::Gone { .. } => State::Gone,
            Phase::Full { .. } => State::Full,
            Phase::Open { .. } if self.session.replica().is_some() => match self.session.settled() {
                Some(settled) if !self.session.has_ready() => {
                    self.progress.settle(self.session.stats().triangles);
                    State::Settled { limited: settled.outcome.limited }
                }
                _ => {
                    let Viewport { width_px, height_px } = self.options.viewport;
                    let guess = state::guess(u64::from(width_px) * u64::from(height_px), self.tolerance_px());
                    let whole = self.session.model().map_or(u64::MAX, |model| model.triangles);
                    let most = self.triangle_limit().min(u32::try_from(whole).unwrap_or(u32::MAX));
                    State::Refining { percent: self.progress.note(self.session.stats().triangles, guess, most) }
                }
            },
            _ if self.kept.is_some() => State::Reconnecting,
            Phase::Waiting { .. } if !matches!(self.state, State::Connecting) => State::Reconnecting,
            // A first attempt that failed is told as what it is.
            _ if matches!(self.state, State::Reconnecting | State::Gone | State::Full) => self.state.clone(),
            _ => State::Connecting,
        };
    }

    fn wake(&self, now: Timestamp, image_due: Option<Timestamp>) -> Option<Timestamp> {
        if self.is_moving() || self.session.has_ready() || !self.requests.is_empty() {
            return Some(now);
        }
        let image = self.needs_image.then(|| image_due.unwrap_or(now)).filter(|_| self.shown().is_some());
        let probe = self.probe.as_ref().map(|(probe, _)| probe.poll_timeout());
        [image, self.session.poll_timeout(), self.connection.poll_timeout(), probe].into_iter().flatten().min()
    }
}

/// A camera in the renderer's terms.
fn render_camera(camera: &Camera) -> RenderCamera {
    RenderCamera { eye: camera.eye, rotation: camera.orientation, projection: camera.projection, near: camera.near }
}

/// Whether the mesh of `kept` is better to look at than that of `fresh`.
fn is_better(kept: &ClientSession, fresh: &ClientSession) -> bool {
    let (Some(old), Some(new)) = (kept.model(), fresh.model()) else { return fresh.model().is_none() };
    if old.hash != new.hash {
        // Another model under the name: what was is no more, but nothing is shown before there is something to show.
        return fresh.stats().batches == 0 && fresh.settled().is_none();
    }
    fresh.settled().is_none() && fresh.stats().triangles < kept.stats().triangles / 10 * 9
}

fn with_causes(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(Some(error), |error| error.source());
    causes.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

#[cfg(test)]
mod tests;
