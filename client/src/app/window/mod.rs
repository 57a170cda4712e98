//! `lodestream view`: the viewer in a native window.
//!
//! - This file: the window's loop. It moves events to the [`Viewer`] and frames between it and the sockets, and draws when the
//!   viewer or the panel want to. - `socket`: connections on threads of their own. - `screen`: surface, renderer, panel on the
//!   GPU. - `device`: another one when it is lost. - `panel`: what a person sees and may set.
//!
//! All decisions are the viewer's: this is to a window what `web` is to a page.

mod device;
mod panel;
mod rehearsal;
mod screen;
mod socket;

use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use lodestream_protocol::time::Timestamp;
use winit::application::ApplicationHandler;
use winit::dpi::PhysicalSize;
use winit::event::{ElementState, MouseButton, MouseScrollDelta, TouchPhase, WindowEvent};
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop, EventLoopProxy};
use winit::keyboard::{ModifiersState, PhysicalKey};
use winit::window::{Window, WindowId};

use super::file::{FileError, write_aside};
use super::viewer::command::{Command, Event};
use super::viewer::state::State;
use super::viewer::{Ending, Request, Viewer, ViewerOptions, Wire};
use crate::camera::Viewport;
use crate::camera::gesture::Press;
use crate::net::target::Target;
use crate::render::RenderError;
use device::Bereft;
use panel::{Surroundings, Wish};
pub use rehearsal::PlayReport;
use rehearsal::Rehearsal;
use screen::{Painted, PaintedPanel, Screen};
use socket::{Incoming, Socket};

/// How long a sentence stays on screen.
const NOTICE_TIME: Duration = Duration::from_secs(6);
/// How long to wait before a window that could not show anything is tried again.
const HIDDEN_PAUSE: Duration = Duration::from_millis(100);
/// Pixels of a line of a wheel.
const LINE_PX: f64 = 50.0;
/// Beginnings of the names of keys that do something again while they are held: those that turn, move and zoom by steps.
const REPEATED: [&str; 6] = ["Arrow", "Equal", "Minus", "Numpad", "Bracket", "Slash"];
/// Beginnings of the names of keys that go from control to control of the panel, and press them.
const FOCUS_KEYS: [&str; 5] = ["Arrow", "Enter", "Escape", "Space", "Tab"];
/// Most bytes of a recording: more than the longest that can be made.
const MAX_RECORDING_BYTES: u64 = 64 << 20;
/// Identity of the mouse among pointers; fingers come after it.
const MOUSE: i32 = 0;

/// What to show and how.
#[derive(Clone, Debug, PartialEq)]
pub struct WindowOptions {
    /// The model.
    pub target: Target,
    /// Size of the window in points.
    pub size: [u32; 2],
    /// Fragment of a link to a view, may be empty.
    pub link: String,
    /// Folder that screenshots and recordings are written to.
    pub folder: PathBuf,
    /// Write a screenshot here when all detail is there, and end.
    pub picture: Option<PathBuf>,
    /// Play this recording when all detail is there, and end with a report.
    pub play: Option<PathBuf>,
    /// Lose the graphics device once, when all detail is there, and write the picture only after that: for tests.
    pub loses_device: bool,
}

/// Why there is no window, or none any more.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WindowError {
    /// No desktop to open a window on. What winit says about it is of use to its developers only.
    #[error("cannot open a window: there is no desktop (WAYLAND_DISPLAY, DISPLAY); lodestream snapshot needs none")]
    NoDesktop,
    /// The system grants no window.
    #[error("the desktop refused to open a window")]
    NoWindow,
    /// Nothing can be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The picture could not be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The recording cannot be read.
    #[error("cannot play {0}")]
    NoRecording(String),
    /// The viewer stopped before there was a picture.
    #[error("there is no picture: {0}")]
    NoPicture(String),
}

/// Opens the window and stays until it is closed.
///
/// # Errors
/// [`WindowError`].
pub fn run(options: WindowOptions) -> Result<Option<PlayReport>, WindowError> {
    let events = EventLoop::<Woken>::with_user_event().build().map_err(|_| WindowError::NoDesktop)?;
    let mut app = App::new(options, events.create_proxy());
    if let Some(path) = &app.options.play {
        let file =
            read_recording(path).map_err(|error| WindowError::NoRecording(format!("{}: {error}", path.display())))?;
        app.rehearsal = Some(Rehearsal::new(file));
    }
    events.run_app(&mut app).map_err(|_| WindowError::NoDesktop)?;
    match app.failure {
        Some(error) => Err(error),
        None => Ok(app.report),
    }
}

/// Something happened on another thread.
#[derive(Clone, Copy, Debug)]
struct Woken;

struct App {
    options: WindowOptions,
    start: Instant,
    viewer: Viewer,
    proxy: EventLoopProxy<Woken>,
    sockets: [Option<Socket>; 2],
    opened: Option<Opened>,
    bereft: Option<Bereft>,
    /// Devices that gave way to others.
    devices_lost: u32,
    cursor_px: [f64; 2],
    modifiers: ModifiersState,
    notice: Option<(String, Timestamp)>,
    /// The recording that was written last.
    recording: Option<PathBuf>,
    /// The panel wants to be drawn at this time.
    panel_due: Option<Timestamp>,
    /// Nothing is shown before.
    hidden_until: Option<Timestamp>,
    /// The viewer has asked for the image that comes next.
    is_asked: bool,
    failure: Option<WindowError>,
    rehearsal: Option<Rehearsal>,
    report: Option<PlayReport>,
}

/// What there is while there is a window.
struct Opened {
    window: Arc<Window>,
    screen: Screen,
    device: String,
    input: egui_winit::State,
}

impl App {
    fn new(options: WindowOptions, proxy: EventLoopProxy<Woken>) -> Self {
        let viewport = Viewport { width_px: options.size[0], height_px: options.size[1] };
        let viewer_options = ViewerOptions {
            link: options.link.clone(),
            // Attempts of many windows after a restart spread by this.
            seed: u64::from(std::process::id()),
            ..ViewerOptions::new(viewport)
        };
        Self {
            viewer: Viewer::new(viewer_options),
            options,
            start: Instant::now(),
            proxy,
            sockets: [None, None],
            opened: None,
            bereft: None,
            devices_lost: 0,
            cursor_px: [0.0; 2],
            modifiers: ModifiersState::empty(),
            notice: None,
            recording: None,
            panel_due: None,
            hidden_until: None,
            is_asked: false,
            failure: None,
            rehearsal: None,
            report: None,
        }
    }

    fn now(&self) -> Timestamp {
        Timestamp(self.start.elapsed())
    }

    fn open(&self, events: &ActiveEventLoop) -> Result<Opened, WindowError> {
        let [width, height] = self.options.size;
        let attributes = Window::default_attributes()
            .with_title(format!("{} - Lodestream", self.options.target.model))
            .with_inner_size(winit::dpi::LogicalSize::new(width, height));
        let window = Arc::new(events.create_window(attributes).map_err(|_| WindowError::NoWindow)?);
        Ok(device::equip(window, egui::Context::default())?)
    }

    fn fail(&mut self, events: &ActiveEventLoop, error: WindowError) {
        self.failure.get_or_insert(error);
        events.exit();
    }

    /// Does what the viewer asks of connections, and carries frames.
    fn exchange(&mut self) {
        let now = self.now();
        for wire in [Wire::Main, Wire::Probe] {
            while let Some(incoming) = self.socket(wire).as_mut().and_then(Socket::poll) {
                match incoming {
                    Incoming::Open => self.viewer.handle_open(wire),
                    Incoming::Frame(frame) => self.viewer.handle_frame(now, wire, &frame),
                    Incoming::Ended(ending) => {
                        *self.socket(wire) = None;
                        self.viewer.handle_end(now, wire, &ending);
                    }
                }
                self.answer_requests();
            }
        }
        self.answer_requests();
        while self.sockets.iter().flatten().all(Socket::may_send)
            && let Some((wire, frame)) = self.viewer.poll_transmit(now)
        {
            if let Some(socket) = self.socket(wire) {
                socket.send(frame);
            }
        }
    }

    fn answer_requests(&mut self) {
        while let Some(request) = self.viewer.poll_request() {
            let (Request::Open(wire) | Request::Close(wire)) = request;
            *self.socket(wire) = None;
            if let Request::Open(_) = request {
                let proxy = self.proxy.clone();
                // A loop that has ended needs no waking.
                let wake = move || {
                    let _ = proxy.send_event(Woken);
                };
                match Socket::open(self.options.target.clone(), wake) {
                    Ok(socket) => *self.socket(wire) = Some(socket),
                    Err(_) => self.viewer.handle_end(self.now(), wire, &Ending::Lost),
                }
            }
        }
    }

    fn socket(&mut self, wire: Wire) -> &mut Option<Socket> {
        &mut self.sockets[match wire {
            Wire::Main => 0,
            Wire::Probe => 1,
        }]
    }

    fn handle_viewer_events(&mut self) {
        while let Some(event) = self.viewer.poll_event() {
            match event {
                Event::Notice(text) => self.notify(text),
                Event::Recorded(file) => self.save("views", "jsonl", |app, path| {
                    write_aside(path, |out| out.write_all(&file))?;
                    app.recording = Some(path.to_owned());
                    Ok(())
                }),
                Event::Marked | Event::Played => self.panel_due = Some(self.now()),
            }
        }
    }

    fn notify(&mut self, text: String) {
        let now = self.now();
        self.notice = Some((text, now + NOTICE_TIME));
        self.panel_due = Some(now);
    }

    /// Plays a recording.
    fn play(&mut self, path: &Path) {
        match read_recording(path) {
            Ok(file) => self.viewer.command(self.now(), Command::Play(file)),
            Err(error) => self.notify(format!("cannot read '{}': {error}", path.display())),
        }
    }

    /// Writes a file of a name that is free and says so, or why not.
    fn save(&mut self, kind: &str, ending: &str, write: impl FnOnce(&mut Self, &Path) -> Result<(), WindowError>) {
        let free = (1..10_000)
            .map(|n| self.options.folder.join(format!("{}-{kind}-{n}.{ending}", self.options.target.model)))
            .find(|path| !path.exists());
        let Some(path) = free else { return self.notify("this folder is full of such files".into()) };
        match write(self, &path) {
            Ok(()) => self.notify(format!("written: {}", path.display())),
            Err(error) => self.notify(with_causes(&error)),
        }
    }

    /// The picture without the panel.
    fn write_picture(&mut self, path: &Path) -> Result<(), WindowError> {
        let lines = self.viewer.lines();
        let scene =
            self.viewer.scene(self.now()).ok_or_else(|| WindowError::NoPicture("no mesh has arrived yet".into()))?;
        let opened = self.opened.as_ref().ok_or_else(|| WindowError::NoPicture("there is no window".into()))?;
        let image = opened.screen.picture(scene, &lines);
        self.viewer.redraw();
        let image = image?;
        write_aside(path, |out| image.encode_png(out).map_err(std::io::Error::other))?;
        Ok(())
    }

    fn grant(&mut self, wish: Wish) {
        let now = self.now();
        match wish {
            Wish::Do(command) => self.viewer.command(now, command),
            Wish::Play => {
                if let Some(path) = self.recording.clone() {
                    self.play(&path);
                }
            }
            Wish::Screenshot => self.save("view", "png", Self::write_picture),
            Wish::CopyLink => {
                let Some(link) = self.viewer.link() else { return };
                let address =
                    format!("http://{}/models/{}#{link}", self.options.target.authority(), self.options.target.model);
                if let Some(opened) = &mut self.opened {
                    opened.input.set_clipboard_text(address);
                }
                self.notify("the link is in the clipboard".into());
            }
        }
    }

    /// Lays out the panel and draws an image with it.
    fn draw(&mut self, events: &ActiveEventLoop) {
        let now = self.now();
        let Some(opened) = &mut self.opened else { return };
        let notice = self.notice.as_ref().filter(|(_, until)| *until > now);
        let surroundings = Surroundings {
            model: &self.options.target.model,
            device: &opened.device,
            has_recording: self.recording.is_some(),
            notice: notice.map(|(text, _)| text.as_str()),
        };
        let notice_end = notice.map(|(_, until)| *until);
        let context = opened.input.egui_ctx().clone();
        let raw = opened.input.take_egui_input(&opened.window);
        let mut wishes = Vec::new();
        let viewer = &mut self.viewer;
        let output = context.run_ui(raw, |_| panel::show(&context, viewer, now, &surroundings, &mut wishes));
        let egui::FullOutput { platform_output, textures_delta, shapes, pixels_per_point, viewport_output, .. } =
            output;
        opened.input.handle_platform_output(&opened.window, platform_output);
        let delay = viewport_output.values().map(|viewport| viewport.repaint_delay).min();
        let soon = delay.filter(|delay| *delay < Duration::from_secs(3600)).map(|delay| now + delay);
        self.panel_due = soon.into_iter().chain(notice_end).min();
        let panel = PaintedPanel {
            primitives: context.tessellate(shapes, pixels_per_point),
            textures: textures_delta,
            pixels_per_point,
        };
        let lines = self.viewer.lines();
        let scene = self.viewer.scene(now);
        match opened.screen.paint(scene, &lines, panel) {
            Ok(Painted::Shown(stats)) => {
                if let Some(stats) = stats
                    && std::mem::take(&mut self.is_asked)
                {
                    self.viewer.note_drawn(now, &stats);
                    if let Some(rehearsal) = &mut self.rehearsal {
                        rehearsal.note_image(Timestamp(self.start.elapsed()), &mut self.viewer);
                    }
                }
            }
            Ok(Painted::Hidden) => self.hidden_until = Some(now + HIDDEN_PAUSE),
            Ok(Painted::Lost) => return self.lose_device(events),
            Err(error) => return self.fail(events, error.into()),
        }
        wishes.into_iter().for_each(|wish| self.grant(wish));
    }

    fn rehearse(&mut self, events: &ActiveEventLoop) {
        let now = self.now();
        let Some(rehearsal) = &mut self.rehearsal else { return };
        rehearsal.poll(now, &mut self.viewer);
        if let State::Gone | State::Failed { .. } = self.viewer.state() {
            let reason = self.viewer.state().to_string();
            return self.fail(events, WindowError::NoPicture(reason));
        }
        if rehearsal.is_over(&self.viewer)
            && let Some(rehearsal) = self.rehearsal.take()
        {
            let device = self.opened.as_ref().map_or("", |opened| &opened.device);
            self.report = rehearsal.report(&self.viewer.figures(now), device);
            events.exit();
        }
    }

    fn finish_picture(&mut self, events: &ActiveEventLoop) {
        let Some(path) = self.options.picture.clone() else { return };
        if self.options.loses_device && self.devices_lost == 0 {
            if let State::Settled { .. } = self.viewer.state()
                && let Some(opened) = &self.opened
            {
                opened.screen.lose_device();
                self.panel_due = Some(self.now());
            }
            return;
        }
        let result = match self.viewer.state() {
            State::Settled { .. } => self.write_picture(&path),
            State::Gone | State::Failed { .. } => Err(WindowError::NoPicture(self.viewer.state().to_string())),
            _ => return,
        };
        match result {
            Ok(()) => events.exit(),
            Err(error) => self.fail(events, error),
        }
    }
}

impl ApplicationHandler<Woken> for App {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        if self.opened.is_some() {
            return;
        }
        match self.open(events) {
            Ok(opened) => {
                let PhysicalSize { width, height } = opened.window.inner_size();
                let viewport = Viewport { width_px: width.max(1), height_px: height.max(1) };
                self.viewer.resize(viewport, opened.window.scale_factor());
                opened.window.request_redraw();
                self.opened = Some(opened);
            }
            Err(error) => self.fail(events, error),
        }
    }

    fn user_event(&mut self, _: &ActiveEventLoop, _: Woken) {
        // What is there is fetched before the loop waits again.
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let now = self.now();
        if let WindowEvent::CloseRequested | WindowEvent::Destroyed = event {
            return events.exit();
        }
        let Some(opened) = &mut self.opened else { return };
        let response = opened.input.on_window_event(&opened.window, &event);
        if response.repaint && !matches!(event, WindowEvent::RedrawRequested) {
            self.panel_due = Some(now);
        }
        let scale = opened.window.scale_factor();
        match event {
            WindowEvent::RedrawRequested => self.draw(events),
            WindowEvent::Resized(PhysicalSize { width, height }) => {
                opened.screen.resize([width, height]);
                self.viewer.resize(Viewport { width_px: width.max(1), height_px: height.max(1) }, scale);
            }
            WindowEvent::DroppedFile(path) => self.play(&path),
            WindowEvent::Focused(false) => self.viewer.cancel(now),
            WindowEvent::ModifiersChanged(modifiers) => self.modifiers = modifiers.state(),
            WindowEvent::CursorMoved { position, .. } => {
                self.cursor_px = [position.x, position.y];
                self.viewer.motion(now, MOUSE, self.cursor_px);
            }
            // Letting go ends a drag wherever the pointer is.
            WindowEvent::MouseInput { state: ElementState::Released, .. } => self.viewer.release(now, MOUSE),
            WindowEvent::KeyboardInput { event, .. } => {
                if let PhysicalKey::Code(code) = event.physical_key
                    && !(self.modifiers.control_key() || self.modifiers.super_key())
                {
                    // winit names keys as browsers do.
                    let name = format!("{code:?}");
                    // A button that was clicked has the focus: it needs few keys, a field for text all of them.
                    let is_taken = response.consumed
                        && (opened.input.egui_ctx().text_edit_focused()
                            || FOCUS_KEYS.iter().any(|beginning| name.starts_with(beginning)));
                    let repeats = !event.repeat || REPEATED.iter().any(|beginning| name.starts_with(beginning));
                    if !is_taken && repeats {
                        let is_down = event.state == ElementState::Pressed;
                        self.viewer.key(now, &name, is_down, self.modifiers.shift_key());
                    }
                }
            }
            // The panel has what lies on it.
            _ if response.consumed => {}
            WindowEvent::MouseInput { state: ElementState::Pressed, button, .. } => {
                let press = match button {
                    MouseButton::Left if !self.modifiers.shift_key() => Press::Primary,
                    MouseButton::Left | MouseButton::Middle | MouseButton::Right => Press::Secondary,
                    _ => return,
                };
                self.viewer.press(now, MOUSE, press, self.cursor_px);
            }
            WindowEvent::MouseWheel { delta, .. } => {
                let up_px = match delta {
                    MouseScrollDelta::LineDelta(_, lines) => f64::from(lines) * LINE_PX * scale,
                    MouseScrollDelta::PixelDelta(position) => position.y,
                };
                self.viewer.wheel(now, self.cursor_px, -up_px);
            }
            WindowEvent::Touch(touch) => {
                // Systems number fingers as they like; the mouse keeps its number.
                let id = (touch.id % 1_000_000) as i32 + 1;
                let at_px = [touch.location.x, touch.location.y];
                match touch.phase {
                    TouchPhase::Started => self.viewer.press(now, id, Press::Primary, at_px),
                    TouchPhase::Moved => self.viewer.motion(now, id, at_px),
                    TouchPhase::Ended => self.viewer.release(now, id),
                    TouchPhase::Cancelled => self.viewer.cancel(now),
                }
            }
            _ => {}
        }
    }

    fn about_to_wait(&mut self, events: &ActiveEventLoop) {
        self.exchange();
        let now = self.now();
        let tick = self.viewer.tick(now);
        self.exchange();
        self.handle_viewer_events();
        self.finish_picture(events);
        self.rehearse(events);
        self.is_asked |= tick.draw;
        self.seek_device(events);
        let Some(opened) = &self.opened else {
            if let Some(at) = self.device_due() {
                events.set_control_flow(ControlFlow::WaitUntil(self.start + at.0));
            }
            return;
        };
        let is_due = tick.draw || self.panel_due.is_some_and(|due| due <= now);
        let hidden = self.hidden_until.filter(|until| *until > now);
        if is_due && hidden.is_none() {
            opened.window.request_redraw();
        }
        // An image that was asked for comes as an event and leads here again.
        let wake = [tick.wake.filter(|_| !tick.draw), self.panel_due.filter(|due| *due > now), hidden];
        events.set_control_flow(match wake.into_iter().flatten().min() {
            Some(at) => ControlFlow::WaitUntil(self.start + at.0),
            None => ControlFlow::Wait,
        });
    }
}

/// A recording, as far as it can be one.
fn read_recording(path: &Path) -> std::io::Result<Vec<u8>> {
    let mut file = Vec::new();
    std::fs::File::open(path)?.take(MAX_RECORDING_BYTES + 1).read_to_end(&mut file)?;
    match file.len() as u64 > MAX_RECORDING_BYTES {
        true => Err(std::io::Error::new(std::io::ErrorKind::FileTooLarge, "it is too large for a recording")),
        false => Ok(file),
    }
}

fn with_causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        // Writing to a string does not fail.
        let _ = write!(text, ": {error}");
        cause = error.source();
    }
    text
}
