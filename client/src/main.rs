//! Command line of the Lodestream client: reads the flags, calls the library, prints, sets the exit code.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::error::ErrorKind;
use clap::{Args, CommandFactory, Parser, Subcommand};
use glam::DVec3;
use lodestream_client::app::drive::Until;
use lodestream_client::app::snapshot::{self, SnapshotOptions};
use lodestream_client::camera::{Detail, Viewport};
use lodestream_client::net::link::{LinkRate, LinkShape, parse_duration};
use lodestream_client::net::target::Target;
use lodestream_protocol::view::UNLIMITED_TRIANGLES;

#[derive(Parser)]
#[command(name = "lodestream", version, about = "Streams huge triangle meshes: exactly the detail that can be seen")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Stream one view of a model without a window; write the image, the mesh or figures
    Snapshot(SnapshotArgs),
}

#[derive(Args)]
struct SnapshotArgs {
    /// Address of the model, such as http://host:port/models/bunny
    #[arg(value_name = "URL")]
    url: Target,
    /// Size of the image in pixels
    #[arg(long, value_name = "WxH", default_value = "1280x720", value_parser = parse_size)]
    size: Viewport,
    /// Camera position in model units; without it the whole model is framed
    #[arg(long, value_name = "X,Y,Z", requires = "target", allow_hyphen_values = true, value_parser = parse_point)]
    eye: Option<DVec3>,
    /// Point looked at in model units
    #[arg(long, value_name = "X,Y,Z", requires = "eye", allow_hyphen_values = true, value_parser = parse_point)]
    target: Option<DVec3>,
    /// Vertical opening angle in degrees
    #[arg(long, value_name = "DEG", default_value = "45", value_parser = parse_fov)]
    fov: f32,
    /// Most triangles to hold at any moment, or 'unlimited'
    #[arg(long, value_name = "N", default_value = "1000000", value_parser = parse_triangles)]
    triangles: u32,
    /// Largest error that may stay, in pixels
    #[arg(long, value_name = "PX", default_value = "1", value_parser = parse_tolerance)]
    tolerance: f32,
    /// Want every op of the model, whatever the view
    #[arg(long)]
    complete: bool,
    /// Rate of the simulated link from the server: 'unlimited' or such as 1Mbit, 256kbit
    #[arg(long, value_name = "RATE", default_value = "unlimited")]
    rate: LinkRate,
    /// One-way latency of the simulated link, such as 50ms
    #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = parse_duration)]
    latency: std::time::Duration,
    /// When to stop: settled, bytes:N or seconds:S
    #[arg(long, value_name = "END", default_value = "settled")]
    until: Until,
    /// Write the image as PNG
    #[arg(long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Write the received mesh as binary PLY
    #[arg(long, value_name = "FILE")]
    export: Option<PathBuf>,
    /// Write figures as JSON
    #[arg(long, value_name = "FILE")]
    stats: Option<PathBuf>,
    /// Print the figures as JSON on standard output
    #[arg(long)]
    json: bool,
}

fn main() -> ExitCode {
    // Usage errors end here, with exit code 2.
    let Command::Snapshot(args) = Cli::parse().command;
    match run_snapshot(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run_snapshot(args: SnapshotArgs) -> anyhow::Result<()> {
    let pose = args.eye.zip(args.target);
    if pose.is_some_and(|(eye, target)| eye == target) {
        Cli::command().error(ErrorKind::ValueValidation, "--eye and --target are the same point").exit();
    }
    let is_quiet = args.output.is_some() || args.export.is_some() || args.stats.is_some();
    let options = SnapshotOptions {
        target: args.url,
        viewport: args.size,
        pose,
        fov_y_rad: args.fov.to_radians(),
        detail: Detail {
            triangle_limit: args.triangles,
            tolerance_px: args.tolerance,
            complete: args.complete,
            two_sided: false,
        },
        shape: LinkShape { rate: args.rate, latency: args.latency, ..LinkShape::default() },
        until: args.until,
        output: args.output,
        export: args.export,
        stats: args.stats,
    };
    let outcome = snapshot::run(&options)?;
    match (args.json, is_quiet) {
        (true, _) => print_line(&serde_json::to_string_pretty(&outcome).context("figures as JSON")?),
        (false, false) => print_line(&outcome.to_string()),
        (false, true) => Ok(()),
    }
}

/// Prints a line; a closed pipe is an error and not a panic.
fn print_line(text: &str) -> anyhow::Result<()> {
    use std::io::Write;
    writeln!(std::io::stdout(), "{text}").context("cannot write to standard output")
}

fn parse_size(text: &str) -> Result<Viewport, String> {
    let parse = |side: &str| side.parse().ok().filter(|side| (1..=16_384).contains(side));
    text.split_once('x')
        .and_then(|(width, height)| Some(Viewport { width_px: parse(width)?, height_px: parse(height)? }))
        .ok_or_else(|| "expected WIDTHxHEIGHT, each from 1 to 16384".into())
}

fn parse_point(text: &str) -> Result<DVec3, String> {
    let numbers: Option<Vec<f64>> =
        text.split(',').map(|number| number.trim().parse().ok().filter(|number: &f64| number.is_finite())).collect();
    match numbers.as_deref() {
        Some(&[x, y, z]) => Ok(DVec3::new(x, y, z)),
        _ => Err("expected three numbers: X,Y,Z".into()),
    }
}

fn parse_fov(text: &str) -> Result<f32, String> {
    let degrees = text.parse().ok().filter(|degrees| (0.001..=179.0).contains(degrees));
    degrees.ok_or_else(|| "expected degrees from 0.001 to 179".into())
}

fn parse_triangles(text: &str) -> Result<u32, String> {
    match text {
        "unlimited" => Ok(UNLIMITED_TRIANGLES),
        _ => text.parse().map_err(|_| "expected a number or 'unlimited'".into()),
    }
}

fn parse_tolerance(text: &str) -> Result<f32, String> {
    let pixels = text.parse().ok().filter(|pixels| (0.0..=1e6).contains(pixels));
    pixels.ok_or_else(|| "expected pixels, at least 0".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_sound() {
        Cli::command().debug_assert();
    }

    #[test]
    fn defaults_are_those_of_the_manual() {
        let cli = Cli::parse_from(["lodestream", "snapshot", "http://h:1/models/x"]);
        let Command::Snapshot(args) = cli.command;
        assert_eq!(args.size, Viewport { width_px: 1280, height_px: 720 });
        assert_eq!((args.fov, args.triangles, args.tolerance), (45.0, 1_000_000, 1.0));
        assert_eq!(
            (args.rate, args.latency, args.until),
            (LinkRate::Unlimited, std::time::Duration::ZERO, Until::Settled)
        );
        assert!(args.eye.is_none() && !args.complete && !args.json);
    }

    #[test]
    fn flags_are_read_and_nonsense_is_refused() {
        let parse = |flags: &str| {
            let words = ["lodestream", "snapshot", "http://h:1/models/x"].into_iter().chain(flags.split_whitespace());
            Cli::try_parse_from(words).map(|cli| {
                let Command::Snapshot(args) = cli.command;
                args
            })
        };
        let args = parse("--eye -1,2.5,-3e2 --target 0,0,0 --size 640x480 --triangles unlimited --complete").unwrap();
        assert_eq!(args.eye, Some(DVec3::new(-1.0, 2.5, -300.0)));
        assert_eq!((args.size.width_px, args.triangles, args.complete), (640, UNLIMITED_TRIANGLES, true));
        let args = parse("--rate 1Mbit --latency 50ms --until bytes:30000 --tolerance 0").unwrap();
        assert_eq!((args.rate, args.until), (LinkRate::BitsPerSec(1_000_000), Until::Bytes(30_000)));
        for flags in [
            "--eye 1,2,3",
            "--target 1,2,3",
            "--eye 1,2 --target 0,0,0",
            "--eye 1,2,nan --target 0,0,0",
            "--size 0x5",
            "--size 5",
            "--fov 180",
            "--fov 0",
            "--triangles -5",
            "--tolerance -1",
            "--rate fast",
            "--latency 50",
            "--until never",
            "--frobnicate",
        ] {
            assert!(parse(flags).is_err_and(|error| error.exit_code() == 2), "{flags}");
        }
    }
}
