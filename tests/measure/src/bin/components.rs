//! What a model of very many components costs: `components [PARTS] [--ply FILE]`. One JSON object per line.
//!
//! Both ends run in this process; bytes are those of frames both ways, without WebSocket headers (2 to 4 bytes a frame) and the
//! HTTP upgrade (some 330 bytes). Server time is that of the first call after a view, which selects and encodes a first batch.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::time::{Duration, Instant};

use glam::DVec3;
use lodestream_client::core::{ClientConfig, ClientSession};
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_server::mesh::export::{PlyOptions, write_ply};
use lodestream_server::session::{Session, SessionConfig};
use lodestream_tests::meshes;
use lodestream_tests::model::TestModel;
use serde_json::json;

/// Triangles of a first image.
const FIRST_IMAGE: u32 = 2000;

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let parts: usize = args.first().and_then(|arg| arg.parse().ok()).unwrap_or(100_000);
    let mesh = meshes::debris(parts, 1);
    if let Some(file) = args.iter().position(|arg| arg == "--ply").and_then(|at| args.get(at + 1)) {
        write_ply(&mesh, &PlyOptions::default(), &mut BufWriter::new(File::create(Path::new(file))?))?;
    }
    let line = |name: &str, value: f64, unit: &str, case: &str| {
        println!("{}", json!({"name": name, "value": value, "unit": unit, "case": format!("{parts}/{case}")}));
    };
    let triangles = mesh.faces.len();
    let start = Instant::now();
    let test = TestModel::new(mesh, None);
    line("components/ingest", start.elapsed().as_secs_f64(), "s", &format!("{triangles} triangles"));
    line("components/spawns", test.model.spawn_count().into(), "", "pack");
    line("components/base", test.model.info().smallest_limit.into(), "triangles", "pack");
    line("components/bits", test.model.info().lattice.bits.into(), "bit", "pack");
    line("components/pack", test.pack().len() as f64, "bytes", "pack");
    let start = Instant::now();
    let reopened = test.reopened();
    line("components/open", start.elapsed().as_secs_f64() * 1e3, "ms", "pack");
    drop(reopened);

    for (name, eye, target) in [
        ("whole", DVec3::new(4.0, 4.0, 14.0), DVec3::ZERO),
        ("near", DVec3::new(1.0, 1.0, 4.0), DVec3::ZERO),
        ("inside", DVec3::new(0.5, 0.3, 2.0), DVec3::new(2.0, 0.0, 3.0)),
    ] {
        for (limit_name, limit) in [("100k", 100_000), ("unlimited", UNLIMITED_TRIANGLES)] {
            let mut view = View::perspective(eye, target, 45f32.to_radians());
            (view.near, view.tolerance_px, view.triangle_limit) = (1e-3, 1.0, limit);
            measure(&test, view, |what, value, unit| line(what, value, unit, &format!("{name}/{limit_name}")));
        }
    }
    Ok(())
}

/// Time that this thread has run where the system tells, so that others on the machine do not count; else time that passed.
enum Clock {
    Thread(Duration),
    Wall(Instant),
}

impl Clock {
    fn thread() -> Option<Duration> {
        let line = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
        line.split_whitespace().next()?.parse().ok().map(Duration::from_nanos)
    }

    fn now() -> Self {
        Self::thread().map_or_else(|| Self::Wall(Instant::now()), Self::Thread)
    }

    fn elapsed(&self) -> Duration {
        match self {
            Self::Thread(start) => Self::thread().unwrap_or(*start).saturating_sub(*start),
            Self::Wall(start) => start.elapsed(),
        }
    }
}

fn measure(test: &TestModel, view: View, line: impl Fn(&str, f64, &str)) {
    let mut server = Session::new(test.model.clone(), SessionConfig::default());
    let mut client = ClientSession::new(ClientConfig { view_interval: Duration::ZERO, ..ClientConfig::default() });
    let mut now = Timestamp::default();
    let (mut bytes, mut first_image, mut largest_frame) = (0, None, 0);
    let mut slowest = Duration::ZERO;
    let mut settle = |client: &mut ClientSession, server: &mut Session, view: View| {
        client.set_view(now, view).expect("the view is valid");
        while client.settled().is_none() {
            now = now + Duration::from_millis(1);
            while let Some(frame) = client.poll_transmit(now) {
                bytes += frame.len();
                server.handle_frame(now, &frame).expect("a valid frame");
            }
            let start = Clock::now();
            let frame = server.poll_transmit(now).expect("the session goes on");
            slowest = slowest.max(start.elapsed());
            if let Some(frame) = frame {
                bytes += frame.len();
                largest_frame = largest_frame.max(frame.len());
                client.handle_frame(now, &frame).expect("a valid frame");
                if client.replica().is_some_and(|replica| replica.triangle_count() >= FIRST_IMAGE) {
                    first_image.get_or_insert(bytes);
                }
            }
        }
        std::mem::take(&mut slowest)
    };
    let first = settle(&mut client, &mut server, view.clone());
    line("components/first_view", first.as_secs_f64() * 1e3, "ms");
    // A moving camera: twenty views, a degree apart.
    let mut moving: Vec<f64> = (1..=20)
        .map(|step| {
            let mut view = view.clone();
            view.eye =
                (glam::DQuat::from_rotation_y(f64::from(step).to_radians()) * DVec3::from_array(view.eye)).into();
            settle(&mut client, &mut server, view).as_secs_f64() * 1e3
        })
        .collect();
    moving.sort_by(f64::total_cmp);
    line("components/view_update_median", moving[10], "ms");
    line("components/view_update_worst", moving[19], "ms");
    line("components/first_image", first_image.unwrap_or_default() as f64, "bytes");
    line("components/largest_frame", largest_frame as f64, "bytes");
    let replica = client.replica().expect("the client has the base");
    line("components/triangles", replica.triangle_count().into(), "triangles");
    line("components/session_memory", server.stats().heap_bytes as f64, "bytes");
    assert_eq!(client.stats().resets, 0, "a fast wrong answer is none");
}
