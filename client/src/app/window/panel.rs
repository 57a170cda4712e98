//! The panel: state, figures, settings. Shows what the viewer says, gives back what a person asks for, decides nothing.

use egui::{Align2, Color32, Context, Pos2, RichText, Slider, Ui};
use lodestream_protocol::time::Timestamp;

use super::super::viewer::command::{Command, Tool};
use super::super::viewer::figures::Figures;
use super::super::viewer::settings::{Auto, Axis, Section, Settings};
use super::super::viewer::state::State;
use super::super::viewer::{Automatic, Viewer};
use crate::camera::UpAxis;
use crate::camera::navigate::StandardView;
use crate::render::Shading;

/// Width of the panel in points: a slider with its name, its value and its box.
const WIDTH: f32 = 350.0;
/// Up to this width in points a window opens with the panel as a bar: more of it would lie on the model. The same in the page.
const NARROW: f32 = 1000.0;

/// What a person asks of the window itself.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Wish {
    /// Something for the viewer.
    Do(Command),
    /// The recording made last.
    Play,
    /// The picture as a file.
    Screenshot,
    /// The link to this view in the clipboard.
    CopyLink,
}

/// What the panel shows besides the viewer's state.
pub(super) struct Surroundings<'a> {
    /// Name of the model.
    pub(super) model: &'a str,
    /// What draws.
    pub(super) device: &'a str,
    /// Whether there is a recording to play.
    pub(super) has_recording: bool,
    /// Sentence for a person, as long as it is worth showing.
    pub(super) notice: Option<&'a str>,
}

/// How the panel looks.
pub(super) fn dress(context: &Context) {
    context.all_styles_mut(|style| {
        let text = style.visuals.text_color();
        // Names of figures are weak, not hard to read.
        style.visuals.weak_text_color = Some(text.gamma_multiply(0.85));
        // The toolkit gives a panel that is a bar the shadow of one without a width: a line beside it.
        style.visuals.window_shadow = egui::Shadow::NONE;
    });
}

/// Lays the panel out and collects wishes.
pub(super) fn show(
    context: &Context,
    viewer: &mut Viewer,
    now: Timestamp,
    surroundings: &Surroundings<'_>,
    wishes: &mut Vec<Wish>,
) {
    let figures = viewer.figures(now);
    let settings = *viewer.settings();
    let window = egui::Window::new(title(surroundings.model, viewer.state()))
        // The title changes, the panel stays the same.
        .id(egui::Id::unique("panel"))
        .anchor(Align2::LEFT_TOP, [12.0, 12.0])
        .default_open(context.content_rect().width() > NARROW)
        .auto_sized();
    window.show(context, |ui| {
        // What is as wide as there is room would cover the picture.
        ui.set_width(WIDTH.min(context.content_rect().width() - 40.0));
        // As high as what is open, but not beyond the window.
        let most = context.content_rect().height() - 80.0;
        egui::ScrollArea::vertical().max_height(most).show(ui, |ui| {
            ui.spacing_mut().slider_width = 104.0;
            show_state(ui, viewer.state());
            show_figures(ui, &figures);
            ui.separator();
            show_views(ui, viewer, wishes);
            ui.collapsing("Detail", |ui| show_detail(ui, &settings, &viewer.automatic(), wishes));
            ui.collapsing("Shading", |ui| show_shading(ui, &settings, viewer, wishes));
            ui.collapsing("Section", |ui| show_section(ui, settings.section, wishes));
            ui.collapsing("Tools", |ui| show_tools(ui, viewer, surroundings.has_recording, wishes));
            ui.label(RichText::new(surroundings.device).small().weak());
        });
    });
    show_marks(context, viewer);
    if let Some(notice) = surroundings.notice {
        egui::Area::new(egui::Id::unique("notice")).anchor(Align2::CENTER_BOTTOM, [0.0, -16.0]).show(context, |ui| {
            egui::Frame::popup(ui.style()).show(ui, |ui| ui.label(notice));
        });
    }
}

/// What can be read where the panel is a bar too.
fn title(model: &str, state: &State) -> String {
    match state {
        State::Settled { .. } => model.to_owned(),
        State::Refining { percent } => format!("{model}, {percent} %"),
        _ => format!("{model}, {}", state.name()),
    }
}

fn set(wishes: &mut Vec<Wish>, key: &str, value: impl ToString) {
    wishes.push(Wish::Do(Command::Set { key: key.into(), value: value.to_string() }));
}

fn show_state(ui: &mut Ui, state: &State) {
    let color = match state {
        State::Settled { .. } => Color32::from_rgb(0x6c, 0xc0, 0x70),
        State::Connecting | State::Refining { .. } => Color32::from_rgb(0x6a, 0xa8, 0xe8),
        State::Reconnecting | State::Full => Color32::from_rgb(0xe8, 0xb0, 0x40),
        State::Gone | State::Failed { .. } => Color32::from_rgb(0xe8, 0x70, 0x60),
    };
    ui.label(RichText::new(state.to_string()).color(color).strong());
    let share = match state {
        State::Refining { percent } => f32::from(*percent) / 100.0,
        State::Settled { .. } => 1.0,
        _ => 0.0,
    };
    ui.add(egui::ProgressBar::new(share).desired_height(4.0).fill(color));
}

fn show_figures(ui: &mut Ui, figures: &Figures) {
    egui::Grid::new("figures").num_columns(2).spacing([12.0, 2.0]).show(ui, |ui| {
        let mut row = |name: &str, value: String| {
            ui.label(RichText::new(name).weak());
            ui.label(RichText::new(value).monospace());
            ui.end_row();
        };
        let unknown = || "-".to_owned();
        row("Triangles", format!("{} of {}", grouped(figures.triangles.into()), grouped(figures.model_triangles)));
        row("Error", figures.error_px.map_or_else(unknown, |px| format!("{px:.2} px")));
        // Nothing at all adds up to minus zero.
        let [kb_per_s, images_per_s] = [figures.bytes_per_s / 1e3 + 0.0, figures.images_per_s + 0.0];
        row("Received", format!("{kb_per_s:.1} KB/s, {}", bytes(figures.bytes_received)));
        row("Round trip", figures.round_trip_ms.map_or_else(unknown, |ms| format!("{ms:.0} ms")));
        row("Images", if images_per_s < 0.5 { "at rest".into() } else { format!("{images_per_s:.0} per s") });
        row("From cache", figures.cache_hits.map_or_else(unknown, |share| format!("{:.0} %", share * 100.0)));
        row("Memory", bytes(figures.memory_bytes));
    });
}

fn show_views(ui: &mut Ui, viewer: &Viewer, wishes: &mut Vec<Wish>) {
    let mut button = |ui: &mut Ui, text: &str, hint: &str, command: Command| {
        if ui.button(text).on_hover_text(hint).clicked() {
            wishes.push(Wish::Do(command));
        }
    };
    ui.horizontal_wrapped(|ui| {
        button(ui, "Fit", "The whole model (F)", Command::Fit);
        for (view, key) in StandardView::ALL.into_iter().zip(["1", "2", "3", "4", "5", "6", "7", "H"]) {
            let name = view.name();
            let title: String = name[..1].to_uppercase() + &name[1..];
            button(ui, &title, &format!("Key {key}"), Command::View(view));
        }
    });
    ui.horizontal(|ui| {
        let navigator = viewer.navigator();
        let mut is_parallel = navigator.is_some_and(|navigator| navigator.is_orthographic());
        if ui.checkbox(&mut is_parallel, "Parallel rays").on_hover_text("Key O").changed() {
            wishes.push(Wish::Do(Command::Orthographic(is_parallel)));
        }
        let mut is_z_up = navigator.is_some_and(|navigator| navigator.orbit().up() == UpAxis::Z);
        if ui.checkbox(&mut is_z_up, "Z is up").changed() {
            wishes.push(Wish::Do(Command::Up(if is_z_up { UpAxis::Z } else { UpAxis::Y })));
        }
    });
}

/// A number that may be left to the program: a box for "auto", a slider for the rest.
struct AutoSlider<'a> {
    key: &'a str,
    name: &'a str,
    unit: &'a str,
    range: std::ops::RangeInclusive<f64>,
    decimals: usize,
}

impl AutoSlider<'_> {
    /// `automatic` is what the program chooses, where the slider starts; `None` if that is no limit. Whoever moves the slider
    /// takes the number in hand.
    fn show(&self, ui: &mut Ui, value: Option<f64>, automatic: Option<f64>, wishes: &mut Vec<Wish>) {
        ui.label(self.name);
        let is_unlimited = value.or(automatic).is_none();
        let mut number = value.or(automatic).unwrap_or(*self.range.end());
        let slider = slider(&mut number, self.range.clone(), self.decimals).logarithmic(true);
        let slider = match (is_unlimited, self.decimals) {
            (true, _) => slider.custom_formatter(|_, _| "no limit".into()),
            (false, 0) => slider
                .suffix(self.unit)
                .custom_formatter(|number, _| grouped(number as u64))
                .custom_parser(|text| text.replace(' ', "").parse().ok()),
            _ => slider.suffix(self.unit),
        };
        let is_set = ui.add(slider).changed();
        let mut is_auto = value.is_none() && !is_set;
        if ui.checkbox(&mut is_auto, "auto").changed() || is_set {
            match is_auto {
                true => set(wishes, self.key, "auto"),
                false => set(wishes, self.key, rounded(number, self.decimals)),
            }
        }
        ui.end_row();
    }
}

/// A slider that changes nothing before someone moves it: what lies between its steps or beyond its ends is shown as it is.
fn slider<Number: egui::emath::Numeric>(
    number: &mut Number,
    range: std::ops::RangeInclusive<Number>,
    decimals: usize,
) -> Slider<'_> {
    Slider::new(number, range).clamping(egui::SliderClamping::Edits).max_decimals(decimals)
}

fn rounded(number: f64, decimals: usize) -> String {
    format!("{number:.decimals$}")
}

fn show_detail(ui: &mut Ui, settings: &Settings, automatic: &Automatic, wishes: &mut Vec<Wish>) {
    let number = |key, name, unit, range, decimals| AutoSlider { key, name, unit, range, decimals };
    egui::Grid::new("detail").num_columns(3).show(ui, |ui| {
        number("triangles", "Triangles", "", 1e3..=2e7, 0).show(
            ui,
            settings.triangles.fixed().map(f64::from),
            Some(automatic.triangles.into()),
            wishes,
        );
        number("tolerance", "Largest error", " px", 0.1..=20.0, 2).show(
            ui,
            settings.tolerance_px.fixed().map(f64::from),
            Some(automatic.tolerance_px.into()),
            wishes,
        );
        number("rate", "Bandwidth", " B/s", 1e4..=1e8, 0).show(
            ui,
            settings.byte_rate.fixed().map(f64::from),
            None,
            wishes,
        );
        number("fps", "Frame rate", " fps", 1.0..=240.0, 0).show(
            ui,
            settings.images_per_s.fixed().map(f64::from),
            Some(automatic.images_per_s.into()),
            wishes,
        );
        number("memory", "Memory", " MiB", 16.0..=16384.0, 0).show(
            ui,
            settings.memory_mib.fixed().map(f64::from),
            Some(automatic.memory_mib.into()),
            wishes,
        );
    });
}

fn show_shading(ui: &mut Ui, settings: &Settings, viewer: &Viewer, wishes: &mut Vec<Wish>) {
    let on = |is_on: bool| if is_on { "on" } else { "off" };
    ui.horizontal(|ui| {
        for (name, value, shading) in [("Smooth", "smooth", Shading::Smooth), ("Flat", "flat", Shading::Flat)] {
            if ui.selectable_label(settings.shading == shading, name).clicked() {
                set(wishes, "shading", value);
            }
        }
    });
    // The words of the page.
    let mut switch = |ui: &mut Ui, key: &str, name: &str, hint: &str, mut value: bool| {
        if ui.checkbox(&mut value, name).on_hover_text(hint).changed() {
            set(wishes, key, on(value));
        }
    };
    switch(ui, "wireframe", "Wireframe", "Edges of the triangles", settings.wireframe);
    switch(ui, "levels", "Detail levels", "Faces coloured by how fine they are", settings.levels);
    switch(ui, "backs", "Mark backs", "Backs of faces in red", settings.backs);
    let has_colors = viewer.model().is_some_and(|model| model.has_colors);
    let is_plain = !(has_colors && settings.colors.fixed().unwrap_or(true));
    switch(
        ui,
        "occlusion",
        "Crevices",
        "Darker crevices (ambient occlusion)",
        settings.occlusion.fixed().unwrap_or(is_plain),
    );
    switch(ui, "morph", "Morphing", "New detail moves into its place", settings.morph.fixed().unwrap_or(true));
    if has_colors {
        switch(ui, "colors", "Colours", "Colours of the model", settings.colors.fixed().unwrap_or(true));
    }
    switch(ui, "gradient", "Gradient", "The background is lighter above", settings.is_gradient());
    ui.horizontal(|ui| {
        let mut color = settings.background.fixed().unwrap_or(crate::render::RenderOptions::default().background);
        if ui.color_edit_button_srgb(&mut color).changed() {
            let [r, g, b] = color;
            set(wishes, "background", format!("{r:02x}{g:02x}{b:02x}"));
        }
        ui.label("Background");
        if settings.background != Auto::Auto && ui.small_button("reset").clicked() {
            set(wishes, "background", "auto");
        }
    });
    show_light(ui, settings, wishes);
}

/// The light's direction as two angles.
fn show_light(ui: &mut Ui, settings: &Settings, wishes: &mut Vec<Wish>) {
    let light = settings.light.fixed().unwrap_or(crate::render::options::DEFAULT_LIGHT).normalize_or(glam::Vec3::Z);
    let (mut right_deg, mut up_deg) = (light.x.atan2(light.z).to_degrees(), light.y.asin().to_degrees());
    let mut changed = false;
    egui::Grid::new("light").num_columns(2).show(ui, |ui| {
        ui.label("Light, sideways");
        changed |= ui.add(slider(&mut right_deg, -90.0..=90.0, 0).suffix("°")).changed();
        ui.end_row();
        ui.label("Light, height");
        changed |= ui.add(slider(&mut up_deg, -80.0..=80.0, 0).suffix("°")).changed();
        ui.end_row();
    });
    if changed {
        let ((sin, cos), (y, level)) = (right_deg.to_radians().sin_cos(), up_deg.to_radians().sin_cos());
        set(wishes, "light", format!("{:.3},{y:.3},{:.3}", sin * level, cos * level));
    }
    if settings.light != Auto::Auto && ui.small_button("Usual light").clicked() {
        set(wishes, "light", "auto");
    }
}

fn show_section(ui: &mut Ui, section: Option<Section>, wishes: &mut Vec<Wish>) {
    let mut next = section;
    ui.horizontal(|ui| {
        if ui.selectable_label(section.is_none(), "Off").clicked() {
            next = None;
        }
        for (name, axis) in [("X", Axis::X), ("Y", Axis::Y), ("Z", Axis::Z)] {
            if ui.selectable_label(section.is_some_and(|section| section.axis == axis), name).clicked() {
                let Section { share, flipped, .. } = section.unwrap_or(Section { axis, share: 0.5, flipped: false });
                next = Some(Section { axis, share, flipped });
            }
        }
    });
    if let Some(section) = &mut next {
        ui.horizontal(|ui| {
            ui.add(slider(&mut section.share, 0.0..=1.0, 3));
            ui.checkbox(&mut section.flipped, "other side");
        });
    }
    if next != section {
        set(wishes, "section", next.map_or("off".into(), |section| section.to_string()));
    }
}

fn show_tools(ui: &mut Ui, viewer: &Viewer, has_recording: bool, wishes: &mut Vec<Wish>) {
    ui.horizontal(|ui| {
        for (name, hint, tool) in [
            ("Turn", "Drags turn the model", Tool::Look),
            ("Measure", "Two clicks on the surface give a distance (M)", Tool::Measure),
            ("Fly", "Drags look around, W A S D Q E fly (G)", Tool::Fly),
        ] {
            if ui.selectable_label(viewer.tool() == tool, name).on_hover_text(hint).clicked() {
                wishes.push(Wish::Do(Command::Tool(tool)));
            }
        }
    });
    let mut is_frozen = viewer.is_frozen();
    let hint = "Detail stays that of the view as it is now; look at it from elsewhere (V)";
    if ui.checkbox(&mut is_frozen, "Freeze the view").on_hover_text(hint).changed() {
        wishes.push(Wish::Do(Command::Freeze(is_frozen)));
    }
    if !viewer.marks().is_empty() && ui.button("Clear marks").clicked() {
        wishes.push(Wish::Do(Command::ClearMarks));
    }
    ui.horizontal(|ui| {
        if ui.button("Screenshot").clicked() {
            wishes.push(Wish::Screenshot);
        }
        if ui.button("Copy link").on_hover_text("The page that shows exactly this view").clicked() {
            wishes.push(Wish::CopyLink);
        }
    });
    ui.horizontal(|ui| match viewer.is_recording() {
        true if ui.button("Stop recording").clicked() => wishes.push(Wish::Do(Command::StopRecording)),
        false if ui.button("Record views").clicked() => wishes.push(Wish::Do(Command::Record)),
        _ => {}
    });
    ui.horizontal(|ui| match viewer.is_playing() {
        true if ui.button("Stop playing").clicked() => wishes.push(Wish::Do(Command::StopPlaying)),
        true => {}
        false => {
            let button = ui.add_enabled(has_recording, egui::Button::new("Play the last recording"));
            if button.on_hover_text("Another one: drop its file on the window").clicked() {
                wishes.push(Wish::Play);
            }
        }
    });
}

/// Rings around the marks, and the distance between two.
fn show_marks(context: &Context, viewer: &Viewer) {
    let painter = context.layer_painter(egui::LayerId::background());
    let color = Color32::from_rgb(0xff, 0xb0, 0x20);
    let mut middle = egui::Vec2::ZERO;
    let at = |point| {
        let [x, y] = viewer.pixel(point)?;
        let scale = f64::from(context.pixels_per_point());
        Some(Pos2::new((x / scale) as f32, (y / scale) as f32))
    };
    let mut shown = 0u8;
    for mark in viewer.marks() {
        let Some(at) = at(mark.point) else { continue };
        let stroke = egui::Stroke::new(1.5, color);
        painter.circle_stroke(at, if mark.is_exact { 4.0 } else { 7.0 }, stroke);
        middle += at.to_vec2();
        shown += 1;
    }
    if let Some((distance, is_exact)) = viewer.distance()
        && shown == 2
    {
        let text = if is_exact { format!("{distance:.6}") } else { format!("{distance:.6} ...") };
        let place = (middle / 2.0).to_pos2() + egui::vec2(0.0, -14.0);
        let font = egui::FontId::proportional(15.0);
        let galley = painter.layout_no_wrap(text, font, Color32::WHITE);
        let area = Align2::CENTER_CENTER.anchor_size(place, galley.size());
        painter.rect_filled(area.expand(4.0), 4.0, Color32::from_black_alpha(170));
        painter.galley(area.min, galley, Color32::WHITE);
    }
}

/// `1 234 567`.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

fn bytes(count: u64) -> String {
    match count {
        0..1_000_000 => format!("{:.1} KB", count as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", count as f64 / 1e6),
        _ => format!("{:.2} GB", count as f64 / 1e9),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::viewer::ViewerOptions;
    use crate::camera::Viewport;

    #[test]
    fn what_nobody_moves_stays_as_it_is() {
        let mut viewer = Viewer::new(ViewerOptions::new(Viewport { width_px: 800, height_px: 600 }));
        // Between the steps of sliders, and beyond their ends.
        let odd = [("triangles", "100"), ("tolerance", "0.333"), ("light", "0.31,0.17,1"), ("section", "x,0.12345")];
        for values in [&[][..], &odd] {
            for &(key, value) in values {
                viewer.command(Timestamp::default(), Command::Set { key: key.into(), value: value.into() });
            }
            let settings = *viewer.settings();
            let mut wishes = Vec::new();
            let context = Context::default();
            for _ in 0..3 {
                let mut output = context.run_ui(egui::RawInput::default(), |ui| {
                    show_detail(ui, &settings, &viewer.automatic(), &mut wishes);
                    show_shading(ui, &settings, &viewer, &mut wishes);
                    show_section(ui, settings.section, &mut wishes);
                });
                // Nothing is drawn, and the toolkit insists that textures are not forgotten.
                output.textures_delta.clear();
            }
            assert_eq!(wishes, [], "{values:?}");
        }
    }

    #[test]
    fn numbers_are_written_for_people() {
        assert_eq!(grouped(0), "0");
        assert_eq!(grouped(999), "999");
        assert_eq!(grouped(1_000), "1 000");
        assert_eq!(grouped(1_234_567), "1 234 567");
        assert_eq!([bytes(950), bytes(2_500_000), bytes(3_000_000_000)], ["0.9 KB", "2.5 MB", "3.00 GB"]);
    }
}
