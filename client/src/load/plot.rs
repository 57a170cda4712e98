//! Plots as SVG texts that stand for themselves. Floats here are for the eye only.

use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::prelude::*;

/// Why a plot was not drawn.
pub type PlotError = DrawingAreaErrorKind<std::io::Error>;

/// Size of a plot in pixels.
const SIZE_PX: (u32, u32) = (600, 340);
/// Height of a bar with its gap, and of the title above.
const BAR_PX: i32 = 24;
const TITLE_PX: i32 = 34;
/// Where bars begin, and how long they are at most: names stand before, figures behind.
const BAR_LEFT_PX: i32 = 190;
const BAR_MAX_PX: f64 = 300.0;
const FONT: &str = "sans-serif";
const COLORS: [RGBColor; 6] = [
    RGBColor(0x1f, 0x5f, 0xb4),
    RGBColor(0xc8, 0x3c, 0x28),
    RGBColor(0x2a, 0x8a, 0x46),
    RGBColor(0x8a, 0x50, 0xa8),
    RGBColor(0xb8, 0x82, 0x14),
    RGBColor(0x50, 0x50, 0x50),
];

/// An axis.
#[derive(Clone, Copy, Debug)]
pub(super) struct Axis {
    /// What and in which unit.
    pub(super) name: &'static str,
    /// `Some(least)` for a logarithmic one; what lies below is drawn there.
    pub(super) log_from: Option<f64>,
}

impl Axis {
    /// From zero.
    pub(super) const fn linear(name: &'static str) -> Self {
        Self { name, log_from: None }
    }

    pub(super) const fn log(name: &'static str, least: f64) -> Self {
        Self { name, log_from: Some(least) }
    }

    fn place(&self, value: f64) -> f64 {
        value.max(self.log_from.unwrap_or(0.0))
    }

    /// A range that holds all values and is not empty.
    fn range(&self, values: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
        let (least, most) =
            values.fold((f64::INFINITY, 0.0), |(least, most): (f64, f64), x| (least.min(x), most.max(x)));
        match self.log_from {
            None => 0.0..if most > 0.0 { most * 1.05 } else { 1.0 },
            Some(from) => {
                // To once, twice or five times a power of ten at both ends: few places on such an axis are labelled.
                let least = if least.is_finite() { least } else { from };
                let most = most.max(least) * 1.02;
                let steps =
                    |value: f64| [0.5, 1.0, 2.0, 5.0, 10.0].map(|step| step * 10f64.powf(value.log10().floor()));
                let below = steps(least).into_iter().rfind(|&step| step <= least);
                let above = steps(most).into_iter().find(|&step| step >= most);
                below.unwrap_or(least / 2.0)..above.unwrap_or(most * 2.0)
            }
        }
    }
}

/// A line, and around it a band.
#[derive(Clone, Debug)]
pub(super) struct Line {
    pub(super) name: String,
    pub(super) points: Vec<(f64, f64)>,
    /// Lower and upper end at each place.
    pub(super) band: Vec<(f64, f64, f64)>,
}

impl Line {
    pub(super) fn new(name: impl Into<String>, points: Vec<(f64, f64)>) -> Self {
        Self { name: name.into(), points, band: Vec::new() }
    }
}

/// Lines over two axes. What is not finite is left out.
pub(super) fn lines(
    title: &str,
    axes: [Axis; 2],
    lines: &[Line],
    legend: SeriesLabelPosition,
) -> Result<String, PlotError> {
    let [x_axis, y_axis] = axes;
    let lines: Vec<Line> = lines
        .iter()
        .map(|line| {
            let is_finite = |point: &(f64, f64)| point.0.is_finite() && point.1.is_finite();
            let points = line.points.iter().filter(|point| is_finite(point));
            let band = line.band.iter().filter(|&&(x, low, high)| is_finite(&(x, low)) && high.is_finite());
            Line {
                name: line.name.clone(),
                points: points.map(|&(x, y)| (x_axis.place(x), y_axis.place(y))).collect(),
                band: band.map(|&(x, a, b)| (x_axis.place(x), y_axis.place(a), y_axis.place(b))).collect(),
            }
        })
        .filter(|line| !line.points.is_empty())
        .collect();
    let x = x_axis.range(lines.iter().flat_map(|line| line.points.iter().map(|point| point.0)));
    let bands = lines.iter().flat_map(|line| line.band.iter().flat_map(|&(_, low, high)| [low, high]));
    let y = y_axis.range(lines.iter().flat_map(|line| line.points.iter().map(|point| point.1)).chain(bands));
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, SIZE_PX).into_drawing_area();
        let names = (title, x_axis.name, y_axis.name);
        match (x_axis.log_from.is_some(), y_axis.log_from.is_some()) {
            (false, false) => draw(&area, names, x, y, &lines, legend)?,
            (true, false) => draw(&area, names, x.log_scale(), y, &lines, legend)?,
            (false, true) => draw(&area, names, x, y.log_scale(), &lines, legend)?,
            (true, true) => draw(&area, names, x.log_scale(), y.log_scale(), &lines, legend)?,
        }
        area.present()?;
    }
    Ok(svg)
}

type Area<'a> = DrawingArea<SVGBackend<'a>, plotters::coord::Shift>;

fn draw<X, Y>(
    area: &Area<'_>,
    (title, x_name, y_name): (&str, &str, &str),
    x: X,
    y: Y,
    lines: &[Line],
    legend: SeriesLabelPosition,
) -> Result<(), PlotError>
where
    X: AsRangedCoord<Value = f64>,
    Y: AsRangedCoord<Value = f64>,
    X::CoordDescType: ValueFormatter<f64>,
    Y::CoordDescType: ValueFormatter<f64>,
{
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(area)
        .caption(title, (FONT, 16))
        .margin(10)
        .margin_right(24)
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(x, y)?;
    chart
        .configure_mesh()
        .x_desc(x_name)
        .y_desc(y_name)
        .x_labels(7)
        .y_labels(7)
        .light_line_style(BLACK.mix(0.05))
        .bold_line_style(BLACK.mix(0.15))
        .x_label_formatter(&|value| short(*value))
        .y_label_formatter(&|value| short(*value))
        .draw()?;
    for (line, color) in lines.iter().zip(COLORS.into_iter().cycle()) {
        let there = line.band.iter().map(|&(x, low, _)| (x, low));
        let back = line.band.iter().rev().map(|&(x, _, high)| (x, high));
        let outline: Vec<(f64, f64)> = there.chain(back).collect();
        if !outline.is_empty() {
            chart.draw_series(std::iter::once(Polygon::new(outline, color.mix(0.18))))?;
        }
        chart
            .draw_series(LineSeries::new(line.points.iter().copied(), color.stroke_width(2)))?
            .label(&line.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color.stroke_width(2)));
    }
    if !lines.is_empty() {
        chart
            .configure_series_labels()
            .position(legend)
            .label_font((FONT, 12))
            .background_style(WHITE.mix(0.6))
            .border_style(BLACK.mix(0.3))
            .draw()?;
    }
    Ok(())
}

/// A bar for each figure, its name before it and itself behind.
pub(super) fn bars(title: &str, bars: &[(&str, f64)]) -> Result<String, PlotError> {
    let height = TITLE_PX + BAR_PX * bars.len() as i32 + 10;
    let most = bars.iter().map(|bar| bar.1).filter(|value| value.is_finite()).fold(0.0, f64::max);
    let mut svg = String::new();
    {
        let area = SVGBackend::with_string(&mut svg, (SIZE_PX.0, height.unsigned_abs())).into_drawing_area();
        area.fill(&WHITE)?;
        area.draw(&Text::new(title.to_owned(), (10, 8), (FONT, 16)))?;
        for (top, (&(name, value), color)) in
            (TITLE_PX..).step_by(BAR_PX as usize).zip(bars.iter().zip(COLORS.into_iter().cycle()))
        {
            let share = if most > 0.0 && value.is_finite() { value.max(0.0) / most } else { 0.0 };
            let right = BAR_LEFT_PX + (share * BAR_MAX_PX) as i32;
            area.draw(&Text::new(name.to_owned(), (10, top + 3), (FONT, 13)))?;
            area.draw(&Rectangle::new([(BAR_LEFT_PX, top), (right, top + BAR_PX - 6)], color.filled()))?;
            area.draw(&Text::new(short(value), (right + 8, top + 3), (FONT, 13)))?;
        }
        area.present()?;
    }
    Ok(svg)
}

/// Three digits and a prefix of the SI.
pub(super) fn short(value: f64) -> String {
    let size = value.abs();
    let (scaled, prefix) = match size {
        _ if size >= 1e9 => (value / 1e9, "G"),
        _ if size >= 1e6 => (value / 1e6, "M"),
        _ if size >= 1e3 => (value / 1e3, "k"),
        _ => (value, ""),
    };
    let digits = match scaled.abs() {
        size if size >= 100.0 || size == 0.0 => 0,
        size if size >= 10.0 => 1,
        size if size >= 1.0 => 2,
        _ => 3,
    };
    let text = format!("{scaled:.digits$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    format!("{text}{prefix}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_short() {
        let check = |value: f64, text: &str| assert_eq!(short(value), text);
        check(0.0, "0");
        check(0.05, "0.05");
        check(1.0, "1");
        check(12.34, "12.3");
        check(100.0, "100");
        check(1234.0, "1.23k");
        check(-5e6, "-5M");
        check(2.5e9, "2.5G");
    }

    #[test]
    fn any_figures_can_be_drawn() {
        let axes = [Axis::linear("x"), Axis::log("y", 0.1)];
        let position = || SeriesLabelPosition::UpperRight;
        for points in [
            vec![],
            vec![(0.0, 0.0)],
            vec![(5.0, 5.0), (5.0, 5.0)],
            vec![(f64::NAN, 1.0), (1.0, f64::INFINITY)],
            vec![(-1.0, -1.0), (1e300, 1e300)],
        ] {
            let band = points.iter().map(|&(x, y)| (x, y, y)).collect();
            let line = Line { name: "<a & b>".into(), points, band };
            for axes in [axes, [axes[1], axes[0]], [axes[0]; 2], [axes[1]; 2]] {
                let svg = lines("t", axes, std::slice::from_ref(&line), position()).unwrap();
                assert!(svg.starts_with("<svg") && svg.contains("</svg>") && !svg.contains("<a &"), "{svg}");
            }
        }
        let drawn = lines("t", axes, &[Line::new("name", vec![(0.0, 1.0), (1.0, 2.0)])], position()).unwrap();
        assert!(drawn.contains("polyline") && drawn.contains("name"));
        let svg = bars("t", &[("a", 5.0), ("b", 0.0), ("c", f64::NAN)]).unwrap();
        assert_eq!(svg.matches("<rect").count(), 4, "the ground and three bars");
    }
}
