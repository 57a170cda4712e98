//! `cargo xtask growth`: how the time and memory of ingest grow with the model, as a table and a plot.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, Result, bail, ensure};
use plotters::prelude::*;

use crate::{root, run, target_dir};

/// Sizes measured without being asked for others, in triangles.
const SIZES: [u64; 6] = [100_000, 300_000, 1_000_000, 3_000_000, 8_000_000, 30_000_000];
/// Scanner noise of the samples, in mean edge lengths.
const NOISE: &str = "0.1";
const FILES: [&str; 2] = ["docs/ingest-growth.md", "docs/ingest-growth.svg"];

/// What one ingest took.
struct Measured {
    triangles: f64,
    vertices: f64,
    seconds: f64,
    cpu_seconds: f64,
    peak_bytes: f64,
    pack_bytes: f64,
}

/// Ingests a generated noisy scan of each size (millions of triangles as arguments, or [`SIZES`]) and writes [`FILES`].
///
/// Samples are kept in a folder for temporary files, since large ones take minutes to make.
pub(crate) fn growth(arguments: &[String]) -> Result<()> {
    let sizes: Vec<u64> = if arguments.is_empty() {
        SIZES.to_vec()
    } else {
        arguments
            .iter()
            .map(|a| a.parse().with_context(|| format!("`{a}` is no number of triangles")))
            .collect::<Result<_>>()?
    };
    run("cargo", &["build", "--release", "-p", "lodestream-server"], &[])?;
    let server = target_dir().join("release").join("lodestream-server");
    let folder = std::env::temp_dir().join("lodestream-growth");
    std::fs::create_dir_all(&folder)?;
    let mut all = Vec::new();
    for size in sizes {
        let measured = measure(&server, &folder, size)?;
        println!("{}", row(&measured));
        all.push(measured);
    }
    let mut table = format!(
        "# How ingest grows\n\nGenerated scans with noise of {NOISE} mean edge lengths, ingested with default options on {} cores by\n\
         `cargo xtask growth`. Memory is the peak resident size.\n\n![growth](ingest-growth.svg)\n\n\
         | triangles | vertices | seconds | M triangles/s | CPU seconds | peak memory, MB | pack, MB |\n\
         | ---: | ---: | ---: | ---: | ---: | ---: | ---: |\n",
        std::thread::available_parallelism().map_or(1, usize::from)
    );
    all.iter().for_each(|measured| writeln!(table, "{}", row(measured)).expect("a string takes all"));
    let [markdown, svg] = FILES.map(|file| root().join(file));
    std::fs::create_dir_all(markdown.parent().context("the files lie in a folder")?)?;
    std::fs::write(&markdown, table)?;
    plot(&all, &svg)?;
    println!("wrote {} and {}", FILES[0], FILES[1]);
    Ok(())
}

fn measure(server: &Path, folder: &Path, size: u64) -> Result<Measured> {
    let sample = folder.join(format!("noisy-{size}.ply"));
    if !sample.exists() {
        let partial = folder.join("partial.ply");
        let size = size.to_string();
        output(server, &["sample", "--triangles", &size, "--noise", NOISE, path(&partial)?])?;
        std::fs::rename(&partial, &sample)?;
    }
    let repository = folder.join("repository");
    let text =
        output(server, &["ingest", path(&sample)?, "--repository", path(&repository)?, "--name", "growth", "--json"])?;
    let report: serde_json::Value = serde_json::from_str(&text)?;
    let number = |pointer: &str| report.pointer(pointer).and_then(serde_json::Value::as_f64);
    let field = |pointer: &str| number(pointer).with_context(|| format!("no {pointer} in {report}"));
    Ok(Measured {
        triangles: field("/build/triangles")?,
        vertices: field("/build/vertices")?,
        seconds: field("/seconds")?,
        cpu_seconds: field("/usage/cpu_seconds")?,
        peak_bytes: field("/usage/peak_memory_bytes")?,
        pack_bytes: field("/bytes")?,
    })
}

fn path(path: &Path) -> Result<&str> {
    path.to_str().context("the path is not UTF-8")
}

fn output(server: &Path, arguments: &[&str]) -> Result<String> {
    let output =
        Command::new(server).args(arguments).output().with_context(|| format!("cannot run {}", server.display()))?;
    if !output.status.success() {
        bail!("`{}` failed: {}", arguments.join(" "), String::from_utf8_lossy(&output.stderr));
    }
    Ok(String::from_utf8(output.stdout)?)
}

fn row(m: &Measured) -> String {
    format!(
        "| {} | {} | {:.2} | {:.2} | {:.2} | {:.0} | {:.1} |",
        m.triangles,
        m.vertices,
        m.seconds,
        m.triangles / m.seconds / 1e6,
        m.cpu_seconds,
        m.peak_bytes / 1e6,
        m.pack_bytes / 1e6
    )
}

/// Two panels over the number of triangles: seconds (both axes logarithmic) and peak memory with what it may be.
fn plot(all: &[Measured], file: &PathBuf) -> Result<()> {
    ensure!(all.len() >= 2, "a plot takes two sizes");
    let area = SVGBackend::new(file, (900, 380)).into_drawing_area();
    area.fill(&WHITE)?;
    let (left, right) = area.split_horizontally(450);
    let sizes = all[0].triangles * 0.8..all[all.len() - 1].triangles * 1.25;
    let most = |of: fn(&Measured) -> f64| all.iter().map(of).fold(0.0, f64::max);
    let least = all.iter().map(|m| m.seconds).fold(f64::INFINITY, f64::min);

    let mut chart = ChartBuilder::on(&left)
        .caption("seconds", ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(35)
        .y_label_area_size(50)
        .build_cartesian_2d(sizes.clone().log_scale(), (least * 0.7..most(|m| m.cpu_seconds) * 1.4).log_scale())?;
    chart.configure_mesh().x_desc("triangles").x_label_formatter(&|x| format!("{x:.0e}")).draw()?;
    let mut line = |name: &str, color: RGBColor, of: fn(&Measured) -> f64| -> Result<()> {
        let points = || all.iter().map(move |m| (m.triangles, of(m)));
        chart
            .draw_series(LineSeries::new(points(), color.stroke_width(2)))?
            .label(name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], color.stroke_width(2)));
        chart.draw_series(points().map(|point| Circle::new(point, 3, color.filled())))?;
        Ok(())
    };
    line("wall", BLUE, |m| m.seconds)?;
    line("CPU", RED, |m| m.cpu_seconds)?;
    chart.configure_series_labels().position(SeriesLabelPosition::UpperLeft).border_style(BLACK).draw()?;

    let allowed = |m: &Measured| 600.0 + 8.0 * m.vertices / 1e6;
    let top = most(|m| m.peak_bytes / 1e6).max(all.iter().map(allowed).fold(0.0, f64::max)) * 1.15;
    let mut chart = ChartBuilder::on(&right)
        .caption("peak memory, MB", ("sans-serif", 18))
        .margin(10)
        .x_label_area_size(35)
        .y_label_area_size(50)
        .build_cartesian_2d(sizes.log_scale(), 0.0..top)?;
    chart.configure_mesh().x_desc("triangles").x_label_formatter(&|x| format!("{x:.0e}")).draw()?;
    chart
        .draw_series(LineSeries::new(all.iter().map(|m| (m.triangles, m.peak_bytes / 1e6)), BLUE.stroke_width(2)))?
        .label("measured")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 16, y)], BLUE.stroke_width(2)));
    chart
        .draw_series(LineSeries::new(all.iter().map(|m| (m.triangles, allowed(m))), BLACK.mix(0.5)))?
        .label("600 MB + 8 B per vertex")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 16, y)], BLACK.mix(0.5)));
    chart.configure_series_labels().position(SeriesLabelPosition::LowerRight).border_style(BLACK).draw()?;
    area.present()?;
    Ok(())
}
