//! Costs over what they grow with, all axes logarithmic.

use std::path::Path;

use anyhow::ensure;
use plotters::prelude::*;

use crate::Found;

/// A named curve.
type Curve<'a> = (&'a str, Vec<(f64, f64)>);

/// Four panels in `session-growth.svg`.
pub(crate) fn write(found: &Found, folder: &Path) -> anyhow::Result<()> {
    let file = folder.join("session-growth.svg");
    let area = SVGBackend::new(&file, (900, 760)).into_drawing_area();
    area.fill(&WHITE)?;
    let panels = area.split_evenly((2, 2));
    let orbits = |orbits: &[crate::Orbit], x: fn(&crate::Orbit) -> f64| -> [Curve<'static>; 3] {
        [
            ("view, p50", orbits.iter().map(|o| (x(o), o.p50_ms)).collect()),
            ("view, p99", orbits.iter().map(|o| (x(o), o.p99_ms)).collect()),
            ("first view", orbits.iter().map(|o| (x(o), o.first_ms)).collect()),
        ]
    };
    let curves = orbits(&found.by_visible, |o| o.visible_ops as f64);
    panel(&panels[0], "server time, ms", "ops of the view", &curves)?;
    let curves = orbits(&found.by_size, |o| o.triangles as f64);
    panel(&panels[1], "server time, ms", "triangles of the model", &curves)?;
    let held = |of: fn(&crate::Held) -> u64| {
        found.held.iter().map(|held| (f64::from(held.vertices), of(held) as f64 / 1e3)).collect()
    };
    let curves: [Curve<'_>; 3] = [
        ("after the first view", held(|h| h.loaded_bytes)),
        ("after an orbit", held(|h| h.moving_bytes)),
        ("at rest", held(|h| h.rest_bytes)),
    ];
    panel(&panels[2], "memory of a session, kB", "vertices of the client", &curves)?;
    let crowds = |of: fn(&crate::Crowd) -> f64| found.crowds.iter().map(|c| (f64::from(c.sessions), of(c))).collect();
    let curves: [Curve<'_>; 3] = [
        ("server, ms per client-second", crowds(|c| c.cpu_ms_per_client_s)),
        ("view to first op, p99, ms", crowds(|c| c.first_op_p99_ms)),
        ("resident, MB", crowds(|c| c.resident_mb)),
    ];
    panel(&panels[3], "many sessions", "sessions", &curves)?;
    area.present()?;
    Ok(())
}

fn panel(
    area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
    title: &str,
    x: &str,
    curves: &[Curve<'_>],
) -> anyhow::Result<()> {
    let points = || curves.iter().flat_map(|(_, points)| points).filter(|(x, y)| *x > 0.0 && *y > 0.0);
    ensure!(points().count() > 0, "nothing to draw for {title}");
    let range = |of: fn(&(f64, f64)) -> f64| {
        let least = points().map(of).fold(f64::INFINITY, f64::min);
        let most = points().map(of).fold(0.0, f64::max);
        least * 0.7..most * 1.6
    };
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(35)
        .y_label_area_size(55)
        .build_cartesian_2d(range(|p| p.0).log_scale(), range(|p| p.1).log_scale())?;
    chart.configure_mesh().x_desc(x).x_label_formatter(&|x| format!("{x:.0e}")).draw()?;
    for ((name, points), color) in curves.iter().zip([BLUE, RED, GREEN]) {
        let points = || points.iter().copied().filter(|(x, y)| *x > 0.0 && *y > 0.0);
        chart
            .draw_series(LineSeries::new(points(), color.stroke_width(2)))?
            .label(*name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color.stroke_width(2)));
        chart.draw_series(points().map(|point| Circle::new(point, 3, color.filled())))?;
    }
    chart.configure_series_labels().position(SeriesLabelPosition::UpperLeft).border_style(BLACK).draw()?;
    Ok(())
}
