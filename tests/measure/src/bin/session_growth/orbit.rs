//! One session with a camera that goes around the model, in process, over a link that takes everything at once.

use std::sync::Arc;
use std::time::Duration;

use anyhow::ensure;
use glam::DVec3;
use lodestream_client::core::{ClientConfig, ClientSession};
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_server::pack::PackedModel;
use lodestream_server::session::{Session, SessionConfig, ops_for_view};

/// An open model.
pub(crate) type Model = Arc<PackedModel>;

/// Views after the first, a degree apart.
const STEPS: u32 = 60;
/// Share by which the visible ops may miss what was asked for.
const CLOSE_ENOUGH: f64 = 0.02;

/// What an orbit cost.
pub(crate) struct Orbit {
    pub(crate) triangles: u64,
    pub(crate) visible_ops: usize,
    /// The first view, from nothing, in ms.
    pub(crate) first_ms: f64,
    /// Of the views after it, in ms.
    pub(crate) p50_ms: f64,
    pub(crate) p99_ms: f64,
    /// Ops sent for a view, median.
    pub(crate) sent_ops: u64,
}

impl Orbit {
    pub(crate) const HEAD: &str =
        "| triangles of the model | ops of the view | first view, ms | view, p50, ms | p99, ms | ops sent, p50 |";

    pub(crate) fn row(&self) -> String {
        let Self { triangles, visible_ops, first_ms, p50_ms, p99_ms, sent_ops } = self;
        format!("| {triangles} | {visible_ops} | {first_ms:.1} | {p50_ms:.2} | {p99_ms:.2} | {sent_ops} |")
    }

    /// The whole object at a pixel.
    pub(crate) fn over_model(model: &Model) -> anyhow::Result<Self> {
        Self::measure(model, 1.0)
    }

    /// With the tolerance at which the first view asks for about so many ops; `None` if the model has too few.
    pub(crate) fn with_visible(model: &Model, ops: usize) -> anyhow::Result<Option<Self>> {
        let (mut low, mut high) = (0.0f32, 1000.0f32);
        for _ in 0..40 {
            let middle = (low + high) / 2.0;
            let found = ops_for_view(model, &view(model, 0, middle))?.len();
            if (found as f64 / ops as f64 - 1.0).abs() < CLOSE_ENOUGH {
                return Self::measure(model, middle).map(Some);
            }
            if found > ops { low = middle } else { high = middle }
        }
        Ok(None)
    }

    fn measure(model: &Model, tolerance_px: f32) -> anyhow::Result<Self> {
        let mut ends = Ends::new(model);
        let first_ms = ends.look(view(model, 0, tolerance_px))?.as_secs_f64() * 1e3;
        let visible_ops = ops_for_view(model, &view(model, 0, tolerance_px))?.len();
        let (mut times, mut sent) = (Vec::new(), Vec::new());
        for step in 1..=STEPS {
            let before = ends.ops();
            times.push(ends.look(view(model, step, tolerance_px))?.as_secs_f64() * 1e3);
            sent.push(ends.ops() - before);
        }
        ends.check()?;
        times.sort_by(f64::total_cmp);
        sent.sort_unstable();
        let at = |share: usize| times[(times.len() - 1) * share / 100];
        let triangles = model.info().triangles;
        Ok(Self { triangles, visible_ops, first_ms, p50_ms: at(50), p99_ms: at(99), sent_ops: sent[sent.len() / 2] })
    }
}

/// Memory of a session under a limit that binds, after an orbit.
pub(crate) struct Held {
    pub(crate) limit: u32,
    pub(crate) vertices: u32,
    pub(crate) loaded_bytes: u64,
    pub(crate) moving_bytes: u64,
    pub(crate) rest_bytes: u64,
}

impl Held {
    pub(crate) const HEAD: &str = "| triangle limit | vertices of the client | after the first view, kB | B/vertex | after an orbit, kB | B/vertex | at rest, kB | B/vertex |";

    pub(crate) fn row(&self) -> String {
        let Self { limit, vertices, .. } = self;
        let of = |bytes: u64| format!("{:.0} | {:.1}", bytes as f64 / 1e3, bytes as f64 / f64::from(*vertices));
        let [loaded, moving, rest] = [self.loaded_bytes, self.moving_bytes, self.rest_bytes].map(of);
        format!("| {limit} | {vertices} | {loaded} | {moving} | {rest} |")
    }

    pub(crate) fn under(model: &Model, limit: u32) -> anyhow::Result<Self> {
        let mut ends = Ends::new(model);
        let limited = |step| View { triangle_limit: limit, ..view(model, step, 0.05) };
        ends.look(limited(0))?;
        let loaded_bytes = ends.server.stats().heap_bytes;
        for step in 1..=STEPS {
            ends.look(limited(step))?;
        }
        ends.check()?;
        let moving_bytes = ends.server.stats().heap_bytes;
        let vertices = ends.client.stats().vertices;
        ends.server.rest();
        let rest_bytes = ends.server.stats().heap_bytes;
        Ok(Self { limit, vertices, loaded_bytes, moving_bytes, rest_bytes })
    }
}

/// The whole model from the side, turned by so many degrees.
fn view(model: &PackedModel, degrees: u32, tolerance_px: f32) -> View {
    let info = model.info();
    let at =
        |q: [i32; 3]| DVec3::from_array(info.lattice.origin) + DVec3::from_array(q.map(f64::from)) * info.lattice.step;
    let (low, high) = (at(info.box_min), at(info.box_max));
    let (center, radius) = ((low + high) / 2.0, low.distance(high) / 2.0);
    let angle = f64::from(degrees).to_radians();
    let eye = center + DVec3::new(angle.sin(), 0.2, angle.cos()) * radius / 22.5f64.to_radians().sin();
    View {
        near: 1e-3 * radius,
        tolerance_px,
        triangle_limit: UNLIMITED_TRIANGLES,
        aspect: 16.0 / 9.0,
        ..View::perspective(eye, center, 45f32.to_radians())
    }
}

/// Both ends.
struct Ends {
    server: Session,
    client: ClientSession,
    now: Timestamp,
}

impl Ends {
    fn new(model: &Model) -> Self {
        Self {
            server: Session::new(model.clone(), SessionConfig::default()),
            client: ClientSession::new(ClientConfig { view_interval: Duration::ZERO, ..ClientConfig::default() }),
            now: Timestamp::default(),
        }
    }

    /// Server time from a view to the last frame that it leads to.
    fn look(&mut self, view: View) -> anyhow::Result<Duration> {
        let Self { server, client, now } = self;
        *now = *now + Duration::from_millis(100);
        client.set_view(*now, view)?;
        let mut time = Duration::ZERO;
        loop {
            let requests: Vec<_> = std::iter::from_fn(|| client.poll_transmit(*now)).collect();
            let start = processor_time();
            for frame in &requests {
                server.handle_frame(*now, frame)?;
            }
            let frame = server.poll_transmit(*now)?;
            time += processor_time() - start;
            match frame {
                Some(frame) => client.handle_frame(*now, &frame)?,
                None if requests.is_empty() => return Ok(time),
                None => {}
            }
        }
    }

    fn ops(&self) -> u64 {
        let stats = self.server.stats();
        stats.splits + stats.collapses
    }

    fn check(&self) -> anyhow::Result<()> {
        let ours = self.server.mirror().map(|mirror| mirror.digest());
        let theirs = self.client.replica().map(|mesh| mesh.digest());
        ensure!(ours == theirs && self.client.stats().resets == 0, "the two ends disagreed");
        Ok(())
    }
}

/// Processor time that this thread has used.
fn processor_time() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(u64::try_from(time.tv_sec).unwrap_or(0), u32::try_from(time.tv_nsec).unwrap_or(0))
}
