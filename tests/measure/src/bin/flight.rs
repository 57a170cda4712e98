//! `flight [MINUTES] [FILE...]`: so many virtual minutes of random flight over slow links, both ends and the link in one process.
//!
//! Every batch is compared by both ends. What is looked at beside that: whether the memory of both ends keeps growing (from part to
//! part, and along a line through the last half of an hour or more), whether a limit is exceeded, and how long a client whose view
//! has not settled hears nothing. One JSON object per link on standard output, progress on standard error; exit code 1 for a
//! mismatch, for memory that grows, or for a silence that the link does not explain.

use std::collections::{BTreeSet, VecDeque};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::ensure;
use glam::DVec3;
use lodestream_client::core::ClientConfig;
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::View;
use lodestream_server::ingest::sample;
use lodestream_server::session::{SessionConfig, ops_for_view};
use lodestream_tests::model::TestModel;
use lodestream_tests::sim::{LinkShape, Pair, PairConfig};
use lodestream_tests::source::Source;
use peak_alloc::PeakAlloc;
use serde_json::json;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;

/// Between two views.
const VIEW_INTERVAL: Duration = Duration::from_millis(100);
const VIEWS_PER_MINUTE: u32 = 600;
/// Parts of a flight whose memory is compared.
const PARTS: usize = 6;
/// By how much the last part may exceed the most of those before it. A flight is random: the last may hold the largest view.
const GROWTH: f64 = 1.25;
/// Shorter flights say nothing about memory: what the views ask for varies more than what may leak.
const LEAST_MINUTES: u32 = 10;
/// Shorter ones say nothing about its trend.
const LEAST_MINUTES_OF_TREND: u32 = 60;
/// By how much a straight line through the last half may rise from its beginning to its end, as a share of what a server allows
/// a session for a mesh of as many triangles as the limit has.
const TREND: f64 = 0.05;
/// What a silence may last beyond a round trip and the largest frame: two views and a little.
const SLACK: Duration = Duration::from_millis(250);

/// Share of the triangle limit that a moving view is owed: a server may leave a twenty-fifth of it until the view rests.
const OWED: f64 = 0.95;
/// How much larger than the tolerance an op may be before a moving view is owed it: a tenth, and a little for what is rounded.
const LATE: f32 = 1.11;

/// Bits per second, one-way latency, triangle limit.
const LINKS: [(f64, Duration, u32); 3] = [
    (256e3, Duration::from_millis(50), 20_000),
    (1e6, Duration::from_millis(50), 100_000),
    (20e6, Duration::from_millis(50), 500_000),
];

const MESHES: [&str; 1] = ["dragon_871k.ply"];
const MADE: [Source; 1] = [Source::Made("stone-300k", || sample::generate(300_000, 0))];

fn main() -> anyhow::Result<ExitCode> {
    let (mut minutes, mut files) = (60, Vec::new());
    for word in std::env::args().skip(1) {
        match word.parse() {
            Ok(number) => minutes = number,
            Err(_) => files.push(PathBuf::from(word)),
        }
    }
    ensure!((1..=100_000).contains(&minutes), "{minutes} minutes are none or too many");
    let sources = if files.is_empty() { Source::of_targets(&MESHES, &MADE)? } else { Source::of_files(files) };
    let mut is_well = true;
    for source in sources {
        let test = TestModel::new(source.mesh()?, None);
        for link in LINKS {
            is_well &= fly(&test, &source.name(), link, minutes)?;
        }
    }
    Ok(if is_well { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// One flight; whether nothing is wrong with it. Both ends panic where they disagree.
fn fly(test: &TestModel, name: &str, link: (f64, Duration, u32), minutes: u32) -> anyhow::Result<bool> {
    let (rate, latency, limit) = link;
    let shape = LinkShape { bytes_per_sec: rate / 8.0, latency };
    let client = ClientConfig { triangle_limit: limit, ..PairConfig::default().client };
    let config = PairConfig { down: shape, up: shape, client, ..PairConfig::default() };
    let before = MEMORY.current_usage();
    let mut pair = Pair::new(test.model.clone(), config);
    let mut camera = Camera::new(test, limit);
    let views = minutes * VIEWS_PER_MINUTE;
    let started = Instant::now();
    let mut ear = Ear::new(shape);
    let (mut session, mut both) = ([0u64; PARTS], [0usize; PARTS]);
    // Means of each minute.
    let (mut session_means, mut both_means) = (vec![0.0; minutes as usize], vec![0.0; minutes as usize]);
    for view in 0..views {
        let next = camera.next_view();
        pair.look(next.clone());
        ear.expects(&pair, next);
        let end = pair.now + VIEW_INTERVAL;
        while pair.now < end {
            if !pair.step(end.since(pair.now)) {
                pair.now = end;
            }
            ear.listen(&pair, test)?;
        }
        let part = view as usize * PARTS / views as usize;
        let held = (pair.server.stats().heap_bytes, MEMORY.current_usage().saturating_sub(before));
        session[part] = session[part].max(held.0);
        both[part] = both[part].max(held.1);
        let minute = (view / VIEWS_PER_MINUTE) as usize;
        session_means[minute] += held.0 as f64 / f64::from(VIEWS_PER_MINUTE);
        both_means[minute] += held.1 as f64 / f64::from(VIEWS_PER_MINUTE);
        if (view + 1) % (10 * VIEWS_PER_MINUTE) == 0 {
            eprintln!(
                "{name}, {rate:.0} bit/s: {} of {minutes} min in {:.0} s",
                (view + 1) / VIEWS_PER_MINUTE,
                started.elapsed().as_secs_f64()
            );
        }
    }
    // What is on its way makes a difference, so both are compared when nothing is.
    pair.settle();
    // It may rest by now.
    pair.server.wake()?;
    let stats = pair.client.stats();
    let ours = pair.server.mirror().map(|mirror| mirror.digest());
    let theirs = pair.client.replica().map(|replica| replica.digest());
    let grows = |parts: &[f64; PARTS]| {
        let most = parts[..PARTS - 1].iter().copied().fold(0.0, f64::max);
        parts[PARTS - 1] > GROWTH * most
    };
    let (session_parts, both_parts) = (session.map(|b| b as f64), both.map(|b| b as f64));
    let mut wrong = Vec::new();
    if ours != theirs || stats.resets > 0 {
        wrong.push("the two ends disagreed");
    }
    if stats.max_triangles_seen > limit {
        wrong.push("the limit was exceeded");
    }
    if minutes >= LEAST_MINUTES && (grows(&session_parts) || grows(&both_parts)) {
        wrong.push("memory keeps growing");
    }
    let trends = [&session_means, &both_means].map(|means| rise(&means[means.len() / 2..]));
    // The client holds about what the server does.
    let allowed = [1.0, 2.0].map(|ends| TREND * ends * f64::from(limit) * bytes_per_triangle());
    if minutes >= LEAST_MINUTES_OF_TREND && trends.iter().zip(allowed).any(|(trend, allowed)| *trend > allowed) {
        wrong.push("memory rises over the last half");
    }
    if ear.stalls > 0 {
        wrong.push("ops were due for longer than the link explains, and nothing came");
    }
    let line = json!({
        "model": name, "bits_per_s": rate, "round_trip_ms": 2 * latency.as_millis() as u64, "limit": limit, "minutes": minutes,
        "views": views, "splits": stats.splits, "collapses": stats.collapses, "bytes": pair.bytes_down(),
        "resets": stats.resets, "most_triangles": stats.max_triangles_seen,
        "longest_silence_ms": ear.longest.as_secs_f64() * 1e3, "explained_ms": ear.explained(&pair).as_secs_f64() * 1e3,
        "stalls": ear.stalls,
        "session_bytes": session, "both_ends_bytes": both,
        "session_bytes_rise": trends[0], "both_ends_bytes_rise": trends[1], "rise_allowed": allowed, "wrong": wrong,
    });
    println!("{line}");
    Ok(wrong.is_empty())
}

/// What a server allows a session for a triangle.
fn bytes_per_triangle() -> f64 {
    let config = SessionConfig::default();
    config.max_bytes as f64 / f64::from(config.triangles())
}

/// By how much the straight line that fits best rises from the first value to the last.
fn rise(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let (mut products, mut squares) = (0.0, 0.0);
    for (i, value) in values.iter().enumerate() {
        let x = i as f64 - (count - 1.0) / 2.0;
        products += x * (value - mean);
        squares += x * x;
    }
    if squares > 0.0 { products / squares * (count - 1.0) } else { 0.0 }
}

/// Listens for silences of a server that owes something.
///
/// A view that moves may ask for nothing new and yet not settle: some ops stay until it rests. So when a silence gets longer than
/// the link explains, what the view asks for is worked out, and only ops that were asked for all the while make it a stall.
struct Ear {
    shape: LinkShape,
    views: VecDeque<(Timestamp, View)>,
    frames: u64,
    heard_at: Timestamp,
    longest: Duration,
    stalls: u32,
}

impl Ear {
    fn new(shape: LinkShape) -> Self {
        let heard_at = Timestamp::default();
        Self { shape, views: VecDeque::new(), frames: 0, heard_at, longest: Duration::ZERO, stalls: 0 }
    }

    /// A round trip, the largest frame so far, and a little.
    fn explained(&self, pair: &Pair) -> Duration {
        let frame = pair.largest_frame_down() as f64 / self.shape.bytes_per_sec;
        2 * self.shape.latency + Duration::from_secs_f64(frame) + SLACK
    }

    fn expects(&mut self, pair: &Pair, view: View) {
        self.views.push_back((pair.now, view));
        let explained = self.explained(pair);
        // The newest of those that are old enough stays, to be compared with.
        while self.views.get(1).is_some_and(|(at, _)| pair.now.since(*at) > explained) {
            self.views.pop_front();
        }
    }

    fn listen(&mut self, pair: &Pair, test: &TestModel) -> anyhow::Result<()> {
        let frames = pair.client.stats().frames;
        if frames != self.frames || pair.client.settled().is_some() {
            (self.frames, self.heard_at) = (frames, pair.now);
            return Ok(());
        }
        let silence = pair.now.since(self.heard_at);
        let explained = self.explained(pair);
        if silence > explained {
            let (Some((at, old)), Some((_, new))) = (self.views.front(), self.views.back()) else { return Ok(()) };
            let old = if pair.now.since(*at) > explained { old } else { return Ok(()) };
            let applied: BTreeSet<u32> = pair.server.applied_ops().into_iter().map(|(op, _)| op).collect();
            let owed = |view: &View| {
                let triangle_limit = (f64::from(view.triangle_limit) * OWED) as u32;
                let tolerance_px = view.tolerance_px * LATE;
                ops_for_view(&test.model, &View { triangle_limit, tolerance_px, ..view.clone() })
            };
            let before: BTreeSet<u32> = owed(old)?.into_iter().collect();
            let due = owed(new)?;
            let due = due.iter().filter(|op| before.contains(op) && !applied.contains(op)).count();
            if due > 0 {
                eprintln!("{due} ops were due for {:.0} ms at {:?}", silence.as_secs_f64() * 1e3, pair.now);
                self.stalls += 1;
            }
            self.heard_at = pair.now;
        } else {
            self.longest = self.longest.max(silence);
        }
        Ok(())
    }
}

/// Flies from point to point around the model, looks at its parts, and sometimes stops or jumps.
struct Camera {
    rng: fastrand::Rng,
    center: DVec3,
    radius: f64,
    eye: DVec3,
    target: DVec3,
    goal: (DVec3, DVec3),
    rest: u32,
    limit: u32,
}

impl Camera {
    fn new(test: &TestModel, limit: u32) -> Self {
        let (lo, hi) = test.clean.bounding_box().expect("the mesh has vertices");
        let (lo, hi) = (DVec3::from_array(lo), DVec3::from_array(hi));
        let (center, radius) = ((lo + hi) / 2.0, (hi - lo).length() / 2.0);
        let eye = center + DVec3::Z * 2.6 * radius;
        Self {
            rng: fastrand::Rng::with_seed(11),
            center,
            radius,
            eye,
            target: center,
            goal: (eye, center),
            rest: 0,
            limit,
        }
    }

    fn point(&mut self, least: f64, most: f64) -> DVec3 {
        let direction = DVec3::from_array(std::array::from_fn(|_| self.rng.f64() - 0.5)).normalize_or(DVec3::Z);
        self.center + direction * self.radius * (least + (most - least) * self.rng.f64())
    }

    fn next_view(&mut self) -> View {
        match self.rng.u32(..1000) {
            0..30 => self.goal = (self.point(0.7, 2.6), self.point(0.0, 0.5)),
            30..40 => self.rest = 20 + self.rng.u32(..60),
            40..43 => {
                self.goal = (self.point(0.9, 3.0), self.center);
                (self.eye, self.target) = self.goal;
            }
            _ => {}
        }
        if self.rest > 0 {
            self.rest -= 1;
        } else {
            self.eye += (self.goal.0 - self.eye) * 0.04;
            self.target += (self.goal.1 - self.target) * 0.04;
        }
        View {
            near: 1e-3 * self.radius,
            aspect: 16.0 / 9.0,
            triangle_limit: self.limit,
            ..View::perspective(self.eye, self.target, 45f32.to_radians())
        }
    }
}
