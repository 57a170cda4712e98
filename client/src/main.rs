//! Command line of the Lodestream client: reads the flags, calls the library, prints, sets the exit code.

use std::fs::File;
use std::io::{BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::Context;
use clap::error::ErrorKind;
use clap::{Args, CommandFactory, Parser, Subcommand};
use glam::DVec3;
use lodestream_client::app::drive::Until;
use lodestream_client::app::file::{check_folder, write_aside};
use lodestream_client::app::snapshot::{self, Look, SnapshotOptions};
use lodestream_client::camera::recording::Recording;
use lodestream_client::camera::{Detail, Viewport, fov_y_of};
use lodestream_client::load::drops::Drops;
use lodestream_client::load::duty::Duty;
use lodestream_client::load::pace::Pace;
use lodestream_client::load::page;
use lodestream_client::load::path::{Path as CameraPath, PathFile};
use lodestream_client::load::{self, LoadOptions};
use lodestream_client::net::link::{LinkRate, LinkShape, Stalls, parse_duration};
use lodestream_client::net::target::Target;
use lodestream_protocol::view::UNLIMITED_TRIANGLES;
use xxhash_rust::xxh3::Xxh3;

#[derive(Parser)]
#[command(name = "lodestream", version, about = "Streams huge triangle meshes: exactly the detail that can be seen")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Show a model in a window
    #[cfg(feature = "window")]
    View(ViewArgs),
    /// Stream one view of a model without a window; write the image, the mesh or figures
    Snapshot(SnapshotArgs),
    /// Let many clients without a picture move through a model, and measure what they get
    Load(LoadArgs),
}

#[cfg(feature = "window")]
#[derive(Args)]
struct ViewArgs {
    /// Address of the model, such as http://host:port/models/bunny; may be a link to a view, with its part after #
    #[arg(value_name = "URL")]
    url: String,
    /// Size of the window
    #[arg(long, value_name = "WxH", default_value = "1280x800", value_parser = parse_size)]
    size: Viewport,
    /// Folder for screenshots and recordings
    #[arg(long, value_name = "DIR", default_value = ".")]
    folder: PathBuf,
    /// Write the picture as PNG when all detail is shown, and end
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
    /// Play this recording when all detail is shown, and end with figures of its images as JSON on standard output
    #[arg(long, value_name = "FILE", conflicts_with = "picture")]
    play: Option<PathBuf>,
    /// Lose the graphics device before the picture is written: for tests
    #[arg(long, hide = true, requires = "picture")]
    lose_device: bool,
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
    /// Opening angle of the image's narrower side in degrees
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
    /// Draw each face in one shade
    #[arg(long)]
    flat: bool,
    /// Draw the edges of the faces
    #[arg(long)]
    wireframe: bool,
    /// Colour faces by their size, from blue (coarse) to red (fine)
    #[arg(long)]
    levels: bool,
    /// Depth of the shadows in crevices, 0 to 1
    #[arg(long, value_name = "DEPTH", default_value = "0", value_parser = parse_depth)]
    occlusion: f32,
    /// Rate of the simulated link, in each direction: 'unlimited' or such as 1Mbit, 256kbit
    #[arg(long, value_name = "RATE", default_value = "unlimited")]
    rate: LinkRate,
    /// One-way latency of the simulated link, such as 50ms
    #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = parse_duration)]
    latency: std::time::Duration,
    /// When to stop: settled, bytes:N or seconds:S
    #[arg(long, value_name = "END", default_value = "settled")]
    until: Until,
    /// Seconds to try to connect again when the connection breaks, 0 for not at all
    #[arg(long, value_name = "S", default_value = "10", value_parser = parse_patience)]
    reconnect: std::time::Duration,
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

#[derive(Args)]
struct LoadArgs {
    /// Address of the model, such as http://host:port/models/bunny
    #[arg(value_name = "URL")]
    url: Target,
    /// Clients, each with a connection, a mesh and a camera of its own
    #[arg(long, value_name = "N", default_value = "1", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    clients: u32,
    /// Time over which the clients begin
    #[arg(long, value_name = "TIME", default_value = "0s", value_parser = parse_duration)]
    ramp: std::time::Duration,
    /// Seconds that each client goes on, the path again and again; without it once along the path, until settled
    #[arg(long, value_name = "S", value_parser = parse_seconds)]
    duration: Option<std::time::Duration>,
    /// orbit (a degree a step), zoom, fly, jump, or a file of recorded views
    #[arg(long, value_name = "PATH", default_value = "orbit")]
    path: String,
    /// Views per second, or 'settled': the next view when the one before has settled [default: 10; 0.5 for jump; the times
    /// of recorded views]
    #[arg(long, value_name = "HZ")]
    view_rate: Option<Pace>,
    /// Share of the time in which a client moves, above 0 to 1: it does so at the beginning of every 10 s
    #[arg(long, value_name = "SHARE", default_value = "1")]
    duty: Duty,
    /// Size of the images that are asked for, in pixels
    #[arg(long, value_name = "WxH", default_value = "1920x1080", value_parser = parse_size)]
    size: Viewport,
    /// Opening angle of the image's narrower side in degrees
    #[arg(long, value_name = "DEG", default_value = "45", value_parser = parse_fov)]
    fov: f32,
    /// Most triangles that a client holds at any moment, or 'unlimited'
    #[arg(long, value_name = "N", default_value = "1000000", value_parser = parse_triangles)]
    triangles: u32,
    /// Largest error that may stay, in pixels
    #[arg(long, value_name = "PX", default_value = "1", value_parser = parse_tolerance)]
    tolerance: f32,
    /// Rate of each client's simulated link, in each direction: 'unlimited' or such as 1Mbit, 256kbit
    #[arg(long, value_name = "RATE", default_value = "unlimited")]
    rate: LinkRate,
    /// One-way latency of the simulated link, such as 50ms
    #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = parse_duration)]
    latency: std::time::Duration,
    /// Share of packets that are lost and sent again, from 0 to 0.5
    #[arg(long, value_name = "P", default_value = "0", value_parser = parse_loss)]
    loss: f64,
    /// Times in which nothing moves: how long they are and how far apart on average, such as 300ms/10s
    #[arg(long, value_name = "LENGTH/INTERVAL")]
    stall: Option<Stalls>,
    /// Connections that break at random and are made anew: the share of clients that lose theirs once, such as 0.2, or how
    /// often each does on average, such as 1/10s
    #[arg(long, value_name = "SHARE|N/TIME")]
    drop: Option<Drops>,
    /// What paths and links are drawn from: the same seed, the same paths and links
    #[arg(long, value_name = "N", default_value = "1")]
    seed: u64,
    /// Threads for all clients together, 0 for one per core
    #[arg(long, value_name = "N", default_value = "0", value_parser = parse_threads)]
    threads: usize,
    /// Write the figures as JSON, to standard output for '-'
    #[arg(long, value_name = "FILE|-")]
    json: Option<PathBuf>,
    /// Write a page with plots, as HTML; asks the server for some views again to find out how their error fell
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
}

fn main() -> ExitCode {
    // Usage errors end here, with exit code 2.
    let result = match Cli::parse().command {
        #[cfg(feature = "window")]
        Command::View(args) => run_view(args),
        Command::Snapshot(args) => run_snapshot(args),
        Command::Load(args) => run_load(args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

#[cfg(feature = "window")]
fn run_view(args: ViewArgs) -> anyhow::Result<()> {
    use lodestream_client::app::window::{self, WindowOptions};
    let (address, link) = args.url.split_once('#').unwrap_or((&args.url, ""));
    let target = address.parse().unwrap_or_else(|error| {
        Cli::command()
            .error(ErrorKind::ValueValidation, format!("'{address}' is no address of a model: {error}"))
            .exit()
    });
    if let Some(path) = &args.picture {
        check_folder(path)?;
    }
    let report = window::run(WindowOptions {
        target,
        size: [args.size.width_px, args.size.height_px],
        link: link.into(),
        folder: args.folder,
        picture: args.picture,
        play: args.play,
        loses_device: args.lose_device,
    })?;
    if let Some(report) = report {
        println!("{}", serde_json::to_string(&report)?);
    }
    Ok(())
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
        fov_y_rad: fov_y_of(args.fov.to_radians(), args.size.aspect()),
        detail: Detail {
            triangle_limit: args.triangles,
            tolerance_px: args.tolerance,
            complete: args.complete,
            two_sided: false,
        },
        look: Look {
            flat: args.flat,
            wireframe: args.wireframe,
            refinement_colors: args.levels,
            occlusion: args.occlusion,
        },
        shape: LinkShape { rate: args.rate, latency: args.latency, ..LinkShape::default() },
        until: args.until,
        reconnect_for: args.reconnect,
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

fn run_load(args: LoadArgs) -> anyhow::Result<()> {
    let (path, path_file) = read_path(&args.path)?;
    let usual_pace = match path {
        CameraPath::Recorded(_) => Pace::Recorded,
        CameraPath::Jump => Pace::PerSecond(0.5),
        CameraPath::Orbit | CameraPath::Zoom | CameraPath::Fly => Pace::PerSecond(10.0),
    };
    let file = args.json.as_deref().filter(|file| *file != Path::new("-"));
    for file in file.into_iter().chain(args.report.as_deref()) {
        check_folder(file)?;
    }
    let options = LoadOptions {
        target: args.url,
        clients: args.clients,
        ramp: args.ramp,
        duration: args.duration,
        path,
        path_file,
        pace: args.view_rate.unwrap_or(usual_pace),
        duty: args.duty,
        viewport: args.size,
        fov_y_rad: fov_y_of(args.fov.to_radians(), args.size.aspect()),
        detail: Detail { triangle_limit: args.triangles, tolerance_px: args.tolerance, ..Detail::default() },
        shape: LinkShape { rate: args.rate, latency: args.latency, loss: args.loss, stalls: args.stall, seed: 0 },
        drops: args.drop,
        seed: args.seed,
        threads: args.threads,
        has_error_curves: args.report.is_some(),
    };
    let report = load::run(options).context("cannot start")?;
    match (&args.json, file) {
        (Some(_), None) => print_line(&serde_json::to_string_pretty(&report).context("figures as JSON")?)?,
        (_, Some(file)) => {
            print_line(&report.to_string())?;
            write_aside(file, |out| {
                serde_json::to_writer_pretty(&mut *out, &report)?;
                out.write_all(b"\n")
            })?;
        }
        (None, None) => print_line(&report.to_string())?,
    }
    if let Some(file) = &args.report {
        let page = page::html(&report).context("cannot draw the report")?;
        write_aside(file, |out| out.write_all(page.as_bytes()))?;
    }
    match report.faults() {
        faults if faults.is_empty() => Ok(()),
        faults => Err(anyhow::anyhow!("{}", faults.join(", "))),
    }
}

/// Passes bytes on and hashes them.
struct Hashed<R> {
    inner: R,
    hash: Xxh3,
}

impl<R: Read> Read for Hashed<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let count = self.inner.read(buffer)?;
        self.hash.update(&buffer[..count]);
        Ok(count)
    }
}

/// A built-in path by its name, else a file.
fn read_path(text: &str) -> anyhow::Result<(CameraPath, Option<PathFile>)> {
    let path = match text {
        "orbit" => CameraPath::Orbit,
        "zoom" => CameraPath::Zoom,
        "fly" => CameraPath::Fly,
        "jump" => CameraPath::Jump,
        file => {
            let opened = File::open(file).with_context(|| {
                format!("--path '{file}' is neither orbit, zoom, fly, jump nor a file that can be read")
            })?;
            let mut bytes = BufReader::new(Hashed { inner: opened, hash: Xxh3::new() });
            let recording = Recording::read(&mut bytes).with_context(|| format!("--path '{file}'"))?;
            let xxh3 = format!("{:016x}", bytes.into_inner().hash.digest());
            let path_file = PathFile { name: file.into(), xxh3, views: recording.views().len() };
            return Ok((CameraPath::Recorded(Arc::new(recording)), Some(path_file)));
        }
    };
    Ok((path, None))
}

/// Prints a line; a closed pipe is an error and not a panic.
fn print_line(text: &str) -> anyhow::Result<()> {
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

fn parse_seconds(text: &str) -> Result<std::time::Duration, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.001..=1e7).contains(seconds));
    seconds.map(std::time::Duration::from_secs_f64).ok_or_else(|| "expected seconds, above 0".into())
}

fn parse_patience(text: &str) -> Result<std::time::Duration, String> {
    let seconds = text.parse().ok().filter(|seconds| (0.0..=1e7).contains(seconds));
    seconds.map(std::time::Duration::from_secs_f64).ok_or_else(|| "expected seconds, 0 or more".into())
}

fn parse_loss(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|share| (0.0..=0.5).contains(share)).ok_or_else(|| "expected a share from 0 to 0.5".into())
}

fn parse_depth(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|depth| (0.0..=1.0).contains(depth)).ok_or_else(|| "expected a number from 0 to 1".into())
}

fn parse_threads(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|threads| *threads <= 1024).ok_or_else(|| "expected a number from 0 to 1024".into())
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
        let Command::Snapshot(args) = cli.command else { panic!("a snapshot was asked for") };
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
                let Command::Snapshot(args) = cli.command else { panic!("a snapshot was asked for") };
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

    #[test]
    fn flags_of_load_are_read_and_nonsense_is_refused() {
        let parse = |flags: &str| {
            let words = ["lodestream", "load", "http://h:1/models/x"].into_iter().chain(flags.split_whitespace());
            Cli::try_parse_from(words).map(|cli| match cli.command {
                Command::Load(args) => args,
                #[cfg(feature = "window")]
                Command::View(_) => panic!("load was asked for"),
                Command::Snapshot(_) => panic!("load was asked for"),
            })
        };
        let args = parse("").unwrap();
        assert_eq!((args.clients, args.duration, args.path.as_str(), args.view_rate), (1, None, "orbit", None));
        assert_eq!((args.size.height_px, args.triangles, args.seed, args.threads), (1080, 1_000_000, 1, 0));
        let args = parse(
            "--clients 1000 --ramp 5s --duration 1.5 --view-rate settled --stall 300ms/10s --loss 0.01 --drop 0.5",
        )
        .unwrap();
        assert_eq!((args.clients, args.view_rate, args.loss), (1000, Some(Pace::Settled), 0.01));
        assert_eq!(args.drop, Some(Drops::Share(0.5)));
        assert_eq!((args.ramp.as_secs(), args.duration.unwrap().as_millis()), (5, 1500));
        assert_eq!(args.stall.unwrap().length.as_millis(), 300);
        for flags in [
            "--clients 0",
            "--duration 0",
            "--view-rate never",
            "--stall 300ms",
            "--drop 2",
            "--drop 10s",
            "--loss 2",
            "--loss nan",
            "--seed -1",
            "--threads many",
            "--complete",
        ] {
            assert!(parse(flags).is_err_and(|error| error.exit_code() == 2), "{flags}");
        }
    }
}
