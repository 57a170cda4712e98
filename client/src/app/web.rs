//! The viewer in a browser: what the page calls.
//!
//! The page owns sockets, the loop of images and the controls (`client/web`); this is a thin layer of numbers and text over
//! [`Viewer`] and the renderer. Times are milliseconds of `performance.now()`, lengths pixels of the canvas.

use std::time::Duration;

use glam::DVec3;
use lodestream_protocol::time::Timestamp;
use wasm_bindgen::prelude::wasm_bindgen;
use web_sys::HtmlCanvasElement;

use super::viewer::command::{Command, Event};
use super::viewer::{Ending, Hint, Request, Viewer, ViewerOptions, Wire};
use crate::camera::gesture::Press;
use crate::camera::{Bounds, Viewport};
use crate::render::canvas::canvas_gpu;
use crate::render::{Acquired, Gpu, Pacing, Renderer, SurfaceTarget};

#[wasm_bindgen]
extern "C" {
    #[wasm_bindgen(js_namespace = console, js_name = error)]
    fn console_error(text: &str);
}

/// Installs what says on the console why the module stopped. The page shows it then.
#[wasm_bindgen(start)]
pub fn start() {
    std::panic::set_hook(Box::new(|panic| console_error(&panic.to_string())));
}

/// Numbers of [`Page::figures`], in this order.
const FIGURES: usize = 17;

/// What is drawn to a canvas.
#[wasm_bindgen]
pub struct Screen {
    gpu: Gpu,
    renderer: Renderer,
    target: SurfaceTarget<'static>,
    /// The canvas gives no images any more.
    is_gone: bool,
}

#[wasm_bindgen]
impl Screen {
    /// A device for the canvas.
    ///
    /// # Errors
    /// A sentence for a person.
    pub async fn open(canvas: HtmlCanvasElement) -> Result<Screen, String> {
        let size = [canvas.width(), canvas.height()];
        let (gpu, surface) = canvas_gpu(canvas).await.map_err(|error| error.to_string())?;
        let target = SurfaceTarget::new(&gpu, surface, size, Pacing::WithScreen).map_err(|error| error.to_string())?;
        let renderer = Renderer::new(&gpu.device, &gpu.queue, target.format());
        Ok(Self { gpu, renderer, target, is_gone: false })
    }

    /// What draws, for people.
    pub fn describe(&self) -> String {
        self.gpu.describe()
    }
}

/// The viewer and what it draws to.
#[wasm_bindgen]
pub struct Page {
    viewer: Viewer,
    screen: Option<Screen>,
    marks: Vec<f64>,
    /// Whether the last image had dark crevices.
    is_occluded: bool,
    /// Text of the last notice, or bytes of the last recording.
    text: String,
    file: Vec<u8>,
}

fn at(now_ms: f64) -> Timestamp {
    Timestamp(Duration::from_secs_f64((now_ms / 1e3).clamp(0.0, 1e9)))
}

fn wire(number: u32) -> Wire {
    if number == 0 { Wire::Main } else { Wire::Probe }
}

#[wasm_bindgen]
impl Page {
    /// A viewer without a screen; `spend` says that the machine need not be spared, `covered` that a picture lies over the canvas. `hint` is centre, radius and smallest limit of the model, or empty.
    #[allow(clippy::too_many_arguments, reason = "numbers cross the border one by one")]
    #[wasm_bindgen(constructor)]
    pub fn new(
        width: u32,
        height: u32,
        ratio: f64,
        auto_triangles: u32,
        auto_memory_mib: u32,
        spend: bool,
        covered: bool,
        hint: &[f64],
        link: &str,
        seed: u32,
    ) -> Page {
        let hint = match *hint {
            [x, y, z, radius, limit] if radius > 0.0 && [x, y, z, radius].iter().all(|x| x.is_finite()) => {
                Some(Hint { bounds: Bounds { center: DVec3::new(x, y, z), radius }, smallest_limit: limit as u32 })
            }
            _ => None,
        };
        let options = ViewerOptions {
            pixels_per_point: ratio,
            auto_triangles,
            auto_memory_mib,
            spend,
            is_covered: covered,
            hint,
            link: link.into(),
            seed: seed.into(),
            ..ViewerOptions::new(Viewport { width_px: width.max(1), height_px: height.max(1) })
        };
        Self {
            viewer: Viewer::new(options),
            screen: None,
            marks: Vec::new(),
            is_occluded: false,
            text: String::new(),
            file: Vec::new(),
        }
    }

    /// Whether what it draws to is gone: it wants another [`Screen`].
    pub fn is_lost(&self) -> bool {
        self.screen.as_ref().is_none_or(|screen| screen.is_gone || screen.gpu.is_lost())
    }

    /// Draws to nothing until there is another [`Screen`].
    pub fn detach(&mut self) {
        self.screen = None;
    }

    /// Draws to this from now on.
    pub fn attach(&mut self, screen: Screen) {
        self.screen = Some(screen);
        self.viewer.redraw();
    }

    /// Takes the socket that the page opened, on which it said `hello`.
    pub fn adopt(&mut self, now_ms: f64, hello: &[u8]) -> bool {
        self.viewer.adopt(at(now_ms), hello)
    }

    /// What to do about sockets: -1 nothing, 0 open the main one, 1 open the other, 2 and 3 close them.
    pub fn request(&mut self) -> i32 {
        match self.viewer.poll_request() {
            None => -1,
            Some(Request::Open(Wire::Main)) => 0,
            Some(Request::Open(Wire::Probe)) => 1,
            Some(Request::Close(Wire::Main)) => 2,
            Some(Request::Close(Wire::Probe)) => 3,
        }
    }

    /// A socket is open.
    pub fn opened(&mut self, socket: u32) {
        self.viewer.handle_open(wire(socket));
    }

    /// A socket brought a frame.
    pub fn frame(&mut self, now_ms: f64, socket: u32, bytes: &[u8]) {
        self.viewer.handle_frame(at(now_ms), wire(socket), bytes);
    }

    /// A socket is closed, or could not be opened. `kind`: lost, closed, full, gone, refused.
    pub fn closed(&mut self, now_ms: f64, socket: u32, kind: &str, code: u16, reason: &str) {
        let ending = match kind {
            "closed" => Ending::Closed { code, reason: reason.into() },
            "full" => Ending::Full,
            "gone" => Ending::NoSuchModel,
            "refused" => Ending::Refused(reason.into()),
            _ => Ending::Lost,
        };
        self.viewer.handle_end(at(now_ms), wire(socket), &ending);
    }

    /// The next frame to send on a socket.
    pub fn transmit(&mut self, now_ms: f64) -> Option<Outgoing> {
        let (wire, frame) = self.viewer.poll_transmit(at(now_ms))?;
        Some(Outgoing { socket: if wire == Wire::Main { 0 } else { 1 }, frame })
    }

    /// The canvas has another size.
    pub fn resize(&mut self, width: u32, height: u32, ratio: f64) {
        self.viewer.resize(Viewport { width_px: width.max(1), height_px: height.max(1) }, ratio);
        if let Some(screen) = &mut self.screen {
            screen.target.resize([width, height]);
        }
    }

    /// A pointer goes down; `secondary` moves instead of turning.
    pub fn press(&mut self, now_ms: f64, id: i32, secondary: bool, x: f64, y: f64) {
        let press = if secondary { Press::Secondary } else { Press::Primary };
        self.viewer.press(at(now_ms), id, press, [x, y]);
    }

    /// A pointer moves.
    pub fn motion(&mut self, now_ms: f64, id: i32, x: f64, y: f64) {
        self.viewer.motion(at(now_ms), id, [x, y]);
    }

    /// A pointer goes up.
    pub fn release(&mut self, now_ms: f64, id: i32) {
        self.viewer.release(at(now_ms), id);
    }

    /// Pointers and keys are lost.
    pub fn cancel(&mut self, now_ms: f64) {
        self.viewer.cancel(at(now_ms));
    }

    /// A wheel turned.
    pub fn wheel(&mut self, now_ms: f64, x: f64, y: f64, down_px: f64) {
        self.viewer.wheel(at(now_ms), [x, y], down_px);
    }

    /// A key went down or up. Says whether it means something.
    pub fn key(&mut self, now_ms: f64, code: &str, is_down: bool, shift: bool) -> bool {
        self.viewer.key(at(now_ms), code, is_down, shift)
    }

    /// Does what a name and a value say, see [`Command::parse`]. `false` if they say nothing.
    pub fn command(&mut self, now_ms: f64, name: &str, value: &str) -> bool {
        let Some(command) = Command::parse(name, value) else { return false };
        self.viewer.command(at(now_ms), command);
        true
    }

    /// Plays a recording.
    pub fn play(&mut self, now_ms: f64, file: Vec<u8>) {
        self.viewer.command(at(now_ms), Command::Play(file));
    }

    /// Goes on to `now_ms`, draws if there is something new, and says in how many milliseconds it wants to be called
    /// again: 0 with the next image, negative if not before something happens.
    ///
    /// # Errors
    /// A sentence for a person: the picture cannot be drawn.
    pub fn tick(&mut self, now_ms: f64) -> Result<f64, String> {
        let now = at(now_ms);
        self.viewer.set_memory_of_program(core::arch::wasm32::memory_size(0) as u64 * 65_536);
        let tick = self.viewer.tick(now);
        if tick.draw {
            self.draw(now)?;
        }
        let Some(wake) = tick.wake else { return Ok(-1.0) };
        // Without a screen nothing can be drawn, and waking up for that would be a busy wait.
        if self.is_lost() && tick.draw {
            return Ok(50.0);
        }
        Ok(wake.since(now).as_secs_f64() * 1e3)
    }

    /// The picture over the canvas goes.
    pub fn uncover(&mut self, now_ms: f64) {
        self.viewer.uncover(at(now_ms));
    }

    /// Draws the picture again even if nothing changed, for a screenshot within this task.
    ///
    /// # Errors
    /// See [`Page::tick`].
    pub fn redraw(&mut self, now_ms: f64) -> Result<(), String> {
        self.draw(at(now_ms))
    }

    /// Name of the state, then what people read, separated by a line feed.
    pub fn state(&self) -> String {
        let state = self.viewer.state();
        format!("{}\n{state}", state.name())
    }

    /// Triangles, limit, triangles of the model, error in pixels, bytes per second, bytes received, milliseconds of a round
    /// trip, images per second, share of cache hits, bytes of memory, bytes uploaded for the last image, most of them,
    /// views sent, bytes of the module's memory, images that went over the allowance, ops applied for the last image, most of them. What is not known is NaN.
    pub fn figures(&mut self, now_ms: f64) -> Vec<f64> {
        let figures = self.viewer.figures(at(now_ms));
        let numbers: [f64; FIGURES] = [
            figures.triangles.into(),
            figures.limit.into(),
            figures.model_triangles as f64,
            figures.error_px.map_or(f64::NAN, f64::from),
            figures.bytes_per_s,
            figures.bytes_received as f64,
            figures.round_trip_ms.unwrap_or(f64::NAN),
            figures.images_per_s,
            figures.cache_hits.unwrap_or(f64::NAN),
            figures.memory_bytes as f64,
            figures.uploaded_bytes as f64,
            figures.most_uploaded_bytes as f64,
            figures.views as f64,
            core::arch::wasm32::memory_size(0) as f64 * 65_536.0,
            figures.images_over_allowance.into(),
            figures.applied_ops.into(),
            figures.most_applied_ops.into(),
        ];
        numbers.to_vec()
    }

    /// For each mark x and y in the image (NaN behind the camera), whether it is exact, and its three coordinates.
    pub fn marks(&mut self) -> Vec<f64> {
        self.marks.clear();
        for mark in self.viewer.marks() {
            let [x, y] = self.viewer.pixel(mark.point).unwrap_or([f64::NAN; 2]);
            let exact = if mark.is_exact { 1.0 } else { 0.0 };
            self.marks.extend([x, y, exact, mark.point.x, mark.point.y, mark.point.z]);
        }
        self.marks.clone()
    }

    /// Distance of the marks in model units, NaN unless there are two.
    pub fn distance(&self) -> f64 {
        self.viewer.distance().map_or(f64::NAN, |(distance, _)| distance)
    }

    /// What happened: marked, notice, recorded, played; empty if nothing did. Text and file of it are fetched apart.
    pub fn event(&mut self) -> String {
        match self.viewer.poll_event() {
            None => String::new(),
            Some(Event::Marked) => "marked".into(),
            Some(Event::Notice(text)) => {
                self.text = text;
                "notice".into()
            }
            Some(Event::Recorded(file)) => {
                self.file = file;
                "recorded".into()
            }
            Some(Event::Played) => "played".into(),
        }
    }

    /// Sentence of the last notice.
    pub fn notice(&self) -> String {
        self.text.clone()
    }

    /// The last recording.
    pub fn recording(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.file)
    }

    /// Settings, tool and camera as lines `name=value`.
    pub fn settings(&self) -> String {
        let mut lines: Vec<String> =
            self.viewer.settings().pairs().into_iter().map(|(key, value)| format!("{key}={value}")).collect();
        let on = |is_on: bool| if is_on { "on" } else { "off" };
        let navigator = self.viewer.navigator();
        lines.push(format!("tool={}", format!("{:?}", self.viewer.tool()).to_lowercase()));
        lines.push(format!("ortho={}", on(navigator.is_some_and(|navigator| navigator.is_orthographic()))));
        let up = navigator.map_or("y".into(), |navigator| format!("{:?}", navigator.orbit().up()).to_lowercase());
        lines.push(format!("up={up}"));
        let automatic = self.viewer.automatic();
        lines.push(format!("auto.triangles={}", automatic.triangles));
        lines.push(format!("auto.tolerance={}", automatic.tolerance_px));
        lines.push(format!("auto.fps={}", automatic.images_per_s));
        lines.push(format!("auto.memory={}", automatic.memory_mib));
        lines.push(format!("auto.gradient={}", on(self.viewer.settings().is_gradient())));
        lines.push(format!("freeze={}", on(self.viewer.is_frozen())));
        lines.push(format!("record={}", on(self.viewer.is_recording())));
        lines.push(format!("play={}", on(self.viewer.is_playing())));
        lines.push(format!("hascolors={}", on(self.viewer.model().is_some_and(|model| model.has_colors))));
        lines.push(format!("occluded={}", on(self.is_occluded)));
        lines.join("\n")
    }

    /// Fragment of a link to this view, empty before there is one.
    pub fn link(&self) -> String {
        self.viewer.link().unwrap_or_default()
    }

    fn draw(&mut self, now: Timestamp) -> Result<(), String> {
        let Some(screen) = self.screen.as_mut().filter(|screen| !screen.is_gone && !screen.gpu.is_lost()) else {
            return Ok(());
        };
        let image = match screen.target.acquire() {
            Acquired::Image(image) => image,
            Acquired::Nothing => return Ok(()),
            Acquired::Lost => {
                screen.is_gone = true;
                return Ok(());
            }
        };
        let [width, height] = screen.target.size();
        screen.renderer.resize(width, height).map_err(|error| error.to_string())?;
        screen.renderer.set_lines(&self.viewer.lines());
        let Some(scene) = self.viewer.scene(now) else { return Ok(()) };
        let drawn = screen.renderer.draw(image.view(), scene.replica, &scene.lattice, &scene.camera, &scene.options);
        let stats = drawn.map_err(|error| error.to_string())?;
        screen.target.present(image);
        self.is_occluded = stats.has_occlusion;
        self.viewer.note_drawn(now, &stats);
        Ok(())
    }
}

/// A frame on its way out.
#[wasm_bindgen]
pub struct Outgoing {
    /// Which socket.
    pub socket: u32,
    frame: Vec<u8>,
}

#[wasm_bindgen]
impl Outgoing {
    /// The frame.
    pub fn bytes(self) -> Vec<u8> {
        self.frame
    }
}
