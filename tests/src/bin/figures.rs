//! First figures for the targets, on mesh files: `figures FILE... [--bits N] [--views N]`. One JSON object per line.
//!
//! Both ends run in this process, so that their time can be told apart; bytes are those of frames, without WebSocket
//! headers (2 to 4 bytes a frame) and the HTTP upgrade (some 330 bytes). Row 5, which counts them, is printed by `row5`.

use std::path::Path;
use std::time::{Duration, Instant};

use fastrand::Rng;
use glam::DVec3;
use lodestream_client::core::{ClientConfig, ClientSession};
use lodestream_protocol::mesh::Replica;
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_server::ingest::read::read_mesh_in_memory;
use lodestream_server::judge::calibration::{CalibrationOptions, calibrate};
use lodestream_server::session::score::Scorer;
use lodestream_server::session::{Session, SessionConfig};
use lodestream_tests::model::TestModel;
use serde_json::json;

fn main() -> anyhow::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let value = |flag: &str| args.iter().position(|a| a == flag).and_then(|i| args.get(i + 1));
    let bits: Option<u8> = value("--bits").and_then(|v| v.parse().ok());
    let views: usize = value("--views").and_then(|v| v.parse().ok()).unwrap_or(40);
    for file in args.iter().take_while(|a| !a.starts_with("--")) {
        let (mesh, _) = read_mesh_in_memory(Path::new(file))?;
        let test = TestModel::new(mesh, bits);
        let case = Path::new(file).file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let line = |name: &str, value: f64, unit: &str| {
            println!("{}", json!({"name": name, "case": case, "value": value, "unit": unit}));
        };
        throughput(&test, &line);
        let subject = Subject::new(&test);
        subject.closures(&test, views, &line);
        calibration(&test, views, &line)?;
    }
    Ok(())
}

/// One client with both ends in this process; seconds spent in either.
struct Timed {
    server: Session,
    client: ClientSession,
    now: Timestamp,
    bytes: u64,
    server_seconds: f64,
    client_seconds: f64,
}

impl Timed {
    fn new(test: &TestModel) -> Self {
        let config = ClientConfig { view_interval: Duration::ZERO, ..ClientConfig::default() };
        Self {
            server: Session::new(test.model.clone(), SessionConfig::default()),
            client: ClientSession::new(config),
            now: Timestamp::default(),
            bytes: 0,
            server_seconds: 0.0,
            client_seconds: 0.0,
        }
    }

    fn settle(&mut self, view: View) {
        self.client.set_view(self.now, view).expect("the view is valid");
        while self.client.settled().is_none() {
            self.now = self.now + Duration::from_millis(1);
            while let Some(frame) = self.client.poll_transmit(self.now) {
                let start = Instant::now();
                self.server.handle_frame(self.now, &frame).expect("a valid frame");
                self.server_seconds += start.elapsed().as_secs_f64();
            }
            let start = Instant::now();
            let frame = self.server.poll_transmit(self.now).expect("the session goes on");
            self.server_seconds += start.elapsed().as_secs_f64();
            if let Some(frame) = frame {
                self.bytes += frame.len() as u64;
                let start = Instant::now();
                self.client.handle_frame(self.now, &frame).expect("a valid frame");
                self.client_seconds += start.elapsed().as_secs_f64();
            }
        }
        assert_eq!(self.client.stats().resets, 0, "a fast wrong answer is none");
    }

    fn replica(&self) -> &Replica {
        self.client.replica().expect("the client has the base")
    }
}

/// Rows 1, 13, 16: a complete load from cold.
fn throughput(test: &TestModel, line: &impl Fn(&str, f64, &str)) {
    let mut runs: Vec<(f64, f64)> = Vec::new();
    for _ in 0..3 {
        let mut pair = Timed::new(test);
        let mut view = View::perspective(DVec3::Z, DVec3::ZERO, 0.8);
        view.complete = true;
        view.triangle_limit = UNLIMITED_TRIANGLES;
        pair.settle(view);
        assert_eq!(u64::from(pair.replica().triangle_count()), test.model.info().triangles);
        let splits = pair.client.stats().splits as f64;
        runs.push((splits / pair.server_seconds, splits / pair.client_seconds));
        if runs.len() == 3 {
            line("1 bits per split, complete from cold", pair.bytes as f64 * 8.0 / splits, "bit");
        }
    }
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    line("13 server, select + mirror + encode", median(runs.iter().map(|r| r.0).collect()), "splits/s");
    line("16 client, decode + apply", median(runs.iter().map(|r| r.1).collect()), "splits/s");
}

/// Where the model lies.
struct Subject {
    center: DVec3,
    radius: f64,
}

impl Subject {
    fn new(test: &TestModel) -> Self {
        let (lo, hi) = test.clean.bounding_box().expect("the mesh has vertices");
        let (lo, hi) = (DVec3::from_array(lo), DVec3::from_array(hi));
        Self { center: (lo + hi) / 2.0, radius: (hi - lo).length() / 2.0 }
    }

    fn view(&self, direction: DVec3, distance: f64) -> View {
        let mut view = View::perspective(self.center + direction * distance, self.center, 45f32.to_radians());
        view.near = self.radius * 1e-3;
        view.triangle_limit = UNLIMITED_TRIANGLES;
        view
    }

    fn random_view(&self, rng: &mut Rng) -> View {
        let direction = DVec3::new(rng.f64() - 0.5, rng.f64() - 0.5, rng.f64() - 0.5).normalize_or(DVec3::Z);
        let mut view = self.view(direction, self.radius * (0.95 + 2.5 * rng.f64()));
        view.tolerance_px = 1.0;
        view
    }

    /// Row 6: P* against the ops wanted for their own sake, which the vertex forest alone would need.
    fn closures(&self, test: &TestModel, views: usize, line: &impl Fn(&str, f64, &str)) {
        let model = &test.model;
        let mut rng = Rng::with_seed(6);
        let mut ratios: Vec<f64> = (0..views)
            .map(|_| {
                let view = self.random_view(&mut rng);
                let scorer = Scorer::new(&view, model.info());
                let wanted = (0..model.op_count())
                    .filter(|&op| scorer.wants(scorer.priority(&model.bounds(op).expect("a sound pack"))))
                    .count();
                let mut pair = Timed::new(test);
                pair.settle(view);
                pair.server.applied_ops().len() as f64 / wanted.max(1) as f64
            })
            .collect();
        ratios.sort_by(f64::total_cmp);
        line("6 ops against the vertex-tree minimum, median", ratios[ratios.len() / 2], "ratio");
    }
}

/// Row 22: the real error over random views in units of the tolerance, as `lodestream-server verify --views` prints it.
fn calibration(test: &TestModel, views: usize, line: &impl Fn(&str, f64, &str)) -> anyhow::Result<()> {
    let options = CalibrationOptions { views: views as u64, seed: 1, tolerance_px: None };
    let found = calibrate(&test.model, &options, &mut |_| {})?;
    line("22 screen error, p99.9", found.error.p999, "tolerances");
    line("22 screen error, maximum", found.error.max, "tolerances");
    if let Some(color) = found.color {
        line("22 colour difference, mean", color.mean, "of full scale");
    }
    Ok(())
}
