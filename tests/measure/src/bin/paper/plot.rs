//! Triangles along the flight, a panel for each model.

use std::path::Path;

use plotters::prelude::*;

use crate::{Step, Subject};

/// Size of a panel in pixels.
const PANEL: (u32, u32) = (450, 360);

pub(crate) fn write(subjects: &[Subject], file: &Path) -> anyhow::Result<()> {
    let area = SVGBackend::new(file, (PANEL.0 * subjects.len() as u32, PANEL.1)).into_drawing_area();
    area.fill(&WHITE)?;
    for (panel, subject) in area.split_evenly((1, subjects.len())).iter().zip(subjects) {
        let most = subject.flight.iter().map(|step| step.without).max().unwrap_or(1);
        let mut chart = ChartBuilder::on(panel)
            .caption(&subject.name, ("sans-serif", 18))
            .margin(10)
            .x_label_area_size(35)
            .y_label_area_size(60)
            .build_cartesian_2d(0.0..subject.flight.len() as f64, 0.0..most as f64 * 1.1)?;
        chart.configure_mesh().x_desc("view").y_desc("triangles").draw()?;
        let splits_only = ("splits only", RED, (|s| s.without) as fn(&Step) -> u64);
        let both = ("splits and collapses", BLUE, (|s| s.with_collapses) as fn(&Step) -> u64);
        for (name, color, of) in [splits_only, both] {
            let points = (0u32..).zip(&subject.flight).map(|(i, step)| (f64::from(i), of(step) as f64));
            chart
                .draw_series(LineSeries::new(points, color.stroke_width(2)))?
                .label(name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color.stroke_width(2)));
        }
        chart.configure_series_labels().position(SeriesLabelPosition::UpperLeft).border_style(BLACK).draw()?;
    }
    area.present()?;
    Ok(())
}
