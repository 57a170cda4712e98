//! Device and panel of a window, and what is done when the device is lost: another one draws the same mesh. Drivers need a moment
//! after a reset, so it is tried a few times; the session goes on meanwhile.

use std::sync::Arc;
use std::time::Duration;

use lodestream_protocol::time::Timestamp;
use winit::event_loop::ActiveEventLoop;
use winit::window::Window;

use super::panel;
use super::screen::Screen;
use super::{App, Opened};
use crate::render::RenderError;

/// Tries after which there is no device to be had.
const MAX_TRIES: u32 = 5;
/// The wait after the first try that failed; each later one is longer by as much.
const PAUSE: Duration = Duration::from_millis(500);

/// A window whose device is gone.
pub(super) struct Bereft {
    window: Arc<Window>,
    context: egui::Context,
    tries: u32,
    next_try: Timestamp,
}

/// Device and panel for a window.
///
/// # Errors
/// [`RenderError`].
pub(super) fn equip(window: Arc<Window>, context: egui::Context) -> Result<Opened, RenderError> {
    let screen = Screen::open(window.clone())?;
    panel::dress(&context);
    let input = egui_winit::State::new(
        context,
        egui::ViewportId::ROOT,
        &window,
        Some(window.scale_factor() as f32),
        window.theme(),
        Some(screen.max_texture_side()),
    );
    Ok(Opened { device: screen.describe(), window, screen, input })
}

impl App {
    /// The device is gone: another one is looked for at once.
    pub(super) fn lose_device(&mut self, events: &ActiveEventLoop) {
        let Some(Opened { window, input, screen, .. }) = self.opened.take() else { return };
        // A window has one surface at a time.
        drop(screen);
        // The panel's textures went with the device, and only a new context says them again; what is open stays open.
        let context = egui::Context::default();
        context.memory_mut(|memory| *memory = input.egui_ctx().memory(Clone::clone));
        self.bereft = Some(Bereft { window, context, tries: 0, next_try: self.now() });
        self.seek_device(events);
    }

    /// Looks for a device for a window that has lost its own, when it is time to.
    pub(super) fn seek_device(&mut self, events: &ActiveEventLoop) {
        let now = self.now();
        let Some(mut bereft) = self.bereft.take_if(|bereft| bereft.next_try <= now) else { return };
        match equip(bereft.window.clone(), bereft.context.clone()) {
            Ok(mut opened) => {
                // It may have another size by now.
                opened.screen.resize(opened.window.inner_size().into());
                opened.window.request_redraw();
                self.opened = Some(opened);
                self.viewer.redraw();
                self.devices_lost += 1;
                self.notify("the graphics device was lost: drawing goes on with a new one".into());
            }
            Err(error) => {
                bereft.tries += 1;
                if bereft.tries >= MAX_TRIES {
                    return self.fail(events, error.into());
                }
                bereft.next_try = now + PAUSE * bereft.tries;
                self.bereft = Some(bereft);
            }
        }
    }

    /// When [`seek_device`](Self::seek_device) has something to do.
    pub(super) fn device_due(&self) -> Option<Timestamp> {
        self.bereft.as_ref().map(|bereft| bereft.next_try)
    }
}
