//! Both ends in this process, so that the time of either can be told apart.

use std::time::Duration;

use anyhow::ensure;
use fastrand::Rng;
use glam::DVec3;
use lodestream_client::core::{ClientConfig, ClientSession};
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_server::judge::calibration::{CalibrationOptions, calibrate};
use lodestream_server::session::score::Scorer;
use lodestream_server::session::{Session, SessionConfig, ops_for_view};
use lodestream_tests::model::TestModel;
use serde_json::json;

use crate::{Options, Report, Subject, median};

/// Row 13: a complete load, from the hello to the last frame.
pub(crate) fn server(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let mut rates = Vec::new();
    let mut splits = 0;
    for _ in 0..options.runs {
        let load = Load::record(&subject.test)?;
        splits = load.splits;
        rates.push(splits as f64 / load.server_time.as_secs_f64());
    }
    let more = json!({"splits": splits, "runs": options.runs});
    report.line("13 server, select + mirror + encode", &subject.name, median(rates), "splits/s", more);
    Ok(())
}

/// Row 18: memory of a session that holds a complete load, before and after it rests, and how fast it comes back.
pub(crate) fn memory(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let mut server = Session::new(subject.test.model.clone(), SessionConfig::default());
    let (client, _) = Load::run(&subject.test, &mut server, |_| {})?;
    let digest = server.mirror().map(|mirror| mirror.digest());
    let vertices = f64::from(client.stats().vertices);
    let moving = server.stats().heap_bytes as f64;
    let parts = per_vertex(&server, vertices);
    let mut rates = Vec::new();
    let mut rested = 0.0;
    for _ in 0..options.runs {
        server.rest();
        rested = server.stats().heap_bytes as f64;
        let start = processor_time();
        server.wake()?;
        rates.push(client.stats().splits as f64 / (processor_time() - start).as_secs_f64());
        ensure!(server.mirror().map(|mirror| mirror.digest()) == digest, "the mesh that came back is another one");
    }
    let rebuilt = server.stats().heap_bytes as f64;
    let more = || json!({"vertices": vertices, "runs": options.runs});
    report.line("18 server memory, moving", &subject.name, moving / vertices, "B/vertex", parts);
    report.line("18 server memory, moving again", &subject.name, rebuilt / vertices, "B/vertex", more());
    report.line("18 server memory, at rest", &subject.name, rested / vertices, "B/vertex", more());
    report.line("18 mirror rebuilt", &subject.name, median(rates), "ops/s", more());
    Ok(())
}

/// Bytes per vertex that the parts of a session hold, and the slots that its mesh has for each.
fn per_vertex(server: &Session, vertices: f64) -> serde_json::Value {
    let parts = server.memory().parts().into_iter().filter(|part| part.1 > 0);
    let mut all: serde_json::Map<_, _> =
        parts.map(|(name, bytes)| (name.to_owned(), json!(bytes as f64 / vertices))).collect();
    let slots = server.mirror().map_or(0, |mirror| mirror.slot_end());
    all.insert("vertices".into(), json!(vertices));
    all.insert("slots".into(), json!(slots));
    all.into()
}

/// Row 16: the frames of a complete load, decoded and applied.
pub(crate) fn client(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let load = Load::record(&subject.test)?;
    let mut rates = Vec::new();
    for _ in 0..options.runs {
        let mut client = new_client();
        let now = Timestamp::default();
        client.set_view(now, complete_view())?;
        while client.poll_transmit(now).is_some() {}
        let start = processor_time();
        for frame in &load.frames {
            client.handle_frame(now, frame)?;
        }
        rates.push(load.splits as f64 / (processor_time() - start).as_secs_f64());
        check(&client, &subject.test)?;
        let digest = client.replica().map(|replica| replica.digest());
        ensure!(digest == Some(load.digest), "the client's mesh is not the server's");
    }
    let bytes: usize = load.frames.iter().map(Vec::len).sum();
    let more =
        json!({"splits": load.splits, "bytes": bytes, "runs": options.runs, "digest": format!("{:016x}", load.digest)});
    report.line("16 client, decode + apply", &subject.name, median(rates), "splits/s", more);
    Ok(())
}

/// A complete load from cold.
struct Load {
    frames: Vec<Vec<u8>>,
    splits: u64,
    /// Of the server's mesh.
    digest: u64,
    server_time: Duration,
}

impl Load {
    fn record(test: &TestModel) -> anyhow::Result<Self> {
        let mut server = Session::new(test.model.clone(), SessionConfig::default());
        let mut frames = Vec::new();
        let (client, server_time) = Self::run(test, &mut server, |frame| frames.push(frame))?;
        let digest = server.mirror().map_or(0, |mirror| mirror.digest());
        Ok(Self { frames, splits: client.stats().splits, digest, server_time })
    }

    /// Runs the load on a fresh session; the client and the server's processor time.
    fn run(
        test: &TestModel,
        server: &mut Session,
        mut keep: impl FnMut(Vec<u8>),
    ) -> anyhow::Result<(ClientSession, Duration)> {
        let mut client = new_client();
        let mut now = Timestamp::default();
        let mut server_time = Duration::ZERO;
        client.set_view(now, complete_view())?;
        while client.settled().is_none() {
            now = now + Duration::from_millis(1);
            let requests: Vec<_> = std::iter::from_fn(|| client.poll_transmit(now)).collect();
            let start = processor_time();
            for frame in &requests {
                server.handle_frame(now, frame)?;
            }
            let frame = server.poll_transmit(now)?;
            server_time += processor_time() - start;
            if let Some(frame) = frame {
                client.handle_frame(now, &frame)?;
                keep(frame);
            }
        }
        check(&client, test)?;
        Ok((client, server_time))
    }
}

fn new_client() -> ClientSession {
    ClientSession::new(ClientConfig { view_interval: Duration::ZERO, ..ClientConfig::default() })
}

fn complete_view() -> View {
    View { complete: true, triangle_limit: UNLIMITED_TRIANGLES, ..View::perspective(DVec3::Z, DVec3::ZERO, 0.8) }
}

/// That the client holds the complete mesh and never disagreed with the server.
fn check(client: &ClientSession, test: &TestModel) -> anyhow::Result<()> {
    let triangles = client.replica().map_or(0, |replica| u64::from(replica.triangle_count()));
    ensure!(triangles == test.model.info().triangles, "{triangles} triangles are not the complete mesh");
    ensure!(client.stats().resets == 0, "the two ends disagreed");
    Ok(())
}

/// Row 6: P* against the ops wanted for their own sake, which the vertex forest alone would need, over random views.
pub(crate) fn closures(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let model = &subject.test.model;
    let mut ratios = Vec::new();
    for view in random_views(&subject.test, options.views) {
        let scorer = Scorer::new(&view, model.info());
        let mut wanted = 0u32;
        for op in 0..model.op_count() {
            wanted += u32::from(scorer.wants(scorer.priority(&model.bounds(op)?)));
        }
        let selected = ops_for_view(model, &view)?.len();
        ensure!(selected >= wanted as usize, "{selected} ops hold not all of the {wanted} wanted");
        ratios.push(selected as f64 / f64::from(wanted.max(1)));
    }
    let most = ratios.iter().copied().fold(0.0, f64::max);
    let more = json!({"most": most, "views": options.views});
    report.line("6 ops against the vertex-tree minimum, median", &subject.name, median(ratios), "ratio", more);
    Ok(())
}

/// Views of the model's centre from anywhere, at 0.95 to 3.45 radii.
pub(crate) fn random_views(test: &TestModel, count: usize) -> Vec<View> {
    let (lo, hi) = test.clean.bounding_box().expect("the mesh has vertices");
    let (lo, hi) = (DVec3::from_array(lo), DVec3::from_array(hi));
    let (center, radius) = ((lo + hi) / 2.0, (hi - lo).length() / 2.0);
    let mut rng = Rng::with_seed(6);
    let mut view = || {
        let direction = DVec3::new(rng.f64() - 0.5, rng.f64() - 0.5, rng.f64() - 0.5).normalize_or(DVec3::Z);
        let eye = center + direction * radius * (0.95 + 2.5 * rng.f64());
        let view = View::perspective(eye, center, 45f32.to_radians());
        View { near: radius * 1e-3, triangle_limit: UNLIMITED_TRIANGLES, ..view }
    };
    (0..count).map(|_| view()).collect()
}

/// Row 22: the real error over random views in units of the tolerance, as `lodestream-server verify --views` prints it.
pub(crate) fn calibration(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let asked = CalibrationOptions { views: options.views as u64, seed: 1, tolerance_px: None };
    let found = calibrate(&subject.test.model, &asked, &mut |_| {})?;
    let more = || json!({"views": options.views});
    report.line("22 screen error, p99.9", &subject.name, found.error.p999, "tolerances", more());
    report.line("22 screen error, maximum", &subject.name, found.error.max, "tolerances", more());
    if let Some(color) = found.color {
        report.line("22 colour difference, mean", &subject.name, color.mean, "full scale", more());
    }
    Ok(())
}

/// Processor time that this thread has used.
pub(crate) fn processor_time() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(u64::try_from(time.tv_sec).unwrap_or(0), u32::try_from(time.tv_nsec).unwrap_or(0))
}

/// Row 14: what one view of a moving camera costs the server, from the view to the last frame that it leads to, over a link that
/// takes everything at once. The client holds 50,000 vertices (100,000 triangles), or all that the model has.
pub(crate) fn view_updates(subject: &Subject, report: &Report) -> anyhow::Result<()> {
    const LIMIT: u32 = 100_000;
    const STEPS: u32 = 200;
    let (lo, hi) = subject.test.clean.bounding_box().expect("the mesh has vertices");
    let (lo, hi) = (DVec3::from_array(lo), DVec3::from_array(hi));
    let (center, radius) = ((lo + hi) / 2.0, (hi - lo).length() / 2.0);
    let orbit = |degrees: f64, distance: f64| {
        let angle = degrees.to_radians();
        (center + DVec3::new(angle.sin(), 0.2, angle.cos()) * distance * radius, center)
    };
    type Path<'a> = (&'a str, f32, &'a dyn Fn(f64) -> (DVec3, DVec3));
    let paths: [Path<'_>; 5] = [
        ("orbit 1 deg, limit binds", 0.05, &|i| orbit(i, 2.0)),
        ("orbit 1 deg, 1 px", 1.0, &|i| orbit(i, 2.0)),
        ("zoom 1 %", 0.3, &|i| orbit(30.0, 3.0 * 0.99f64.powf(i))),
        ("fly past", 0.3, &|i| {
            let eye = center + DVec3::new(-1.5 + 0.015 * i, 0.3, 0.9) * radius;
            (eye, eye + DVec3::new(0.4, -0.1, -1.0))
        }),
        ("look around 1 deg, close", 0.3, &|i| {
            let (eye, target) = orbit(40.0, 0.95);
            let turn = glam::DQuat::from_rotation_y((0.3 * (i * 0.06).sin()).max(-1.0));
            (eye, eye + turn * (target - eye))
        }),
    ];
    for (name, tolerance, path) in paths {
        let mut server = Session::new(subject.test.model.clone(), SessionConfig::default());
        let mut client = new_client();
        let mut now = Timestamp::default();
        let (mut times, mut ops, mut vertices, mut tested) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for step in 0..STEPS {
            let (eye, target) = path(f64::from(step));
            let view = View {
                // It follows the camera, as that of a viewer does.
                near: 1e-4 * eye.distance(target),
                tolerance_px: tolerance,
                triangle_limit: LIMIT,
                aspect: 16.0 / 9.0,
                ..View::perspective(eye, target, 45f32.to_radians())
            };
            now = now + Duration::from_millis(100);
            client.set_view(now, view)?;
            let before = server.stats();
            let mut time = Duration::ZERO;
            loop {
                let requests: Vec<_> = std::iter::from_fn(|| client.poll_transmit(now)).collect();
                let start = processor_time();
                for frame in &requests {
                    server.handle_frame(now, frame)?;
                }
                let frame = server.poll_transmit(now)?;
                time += processor_time() - start;
                match frame {
                    Some(frame) => client.handle_frame(now, &frame)?,
                    None if requests.is_empty() => break,
                    None => {}
                }
            }
            let after = server.stats();
            // The first view is a load, not an update.
            if step > 0 {
                times.push(time.as_secs_f64() * 1e3);
                ops.push((after.splits + after.collapses - before.splits - before.collapses) as f64);
                tested.push((after.tested - before.tested) as f64);
                vertices.push(client.replica().map_or(0, |replica| replica.vertex_count()) as f64);
            }
        }
        let (client_digest, server_digest) =
            (client.replica().map(|mesh| mesh.digest()), server.mirror().map(|mesh| mesh.digest()));
        ensure!(client_digest == server_digest && client.stats().resets == 0, "the two ends disagreed");
        times.sort_by(f64::total_cmp);
        let case = format!("{}, {name}", subject.name);
        let last = vertices.last().copied().unwrap_or(1.0);
        let memory = server.stats().heap_bytes as f64 / last;
        report.line("18 server memory after views", &case, memory, "B/vertex", per_vertex(&server, last));
        let more = json!({"p50": times[times.len() / 2], "vertices": median(vertices), "ops": median(ops), "tested": median(tested)});
        report.line("14 server time per view update, p99", &case, times[times.len() * 99 / 100], "ms", more);
    }
    Ok(())
}
