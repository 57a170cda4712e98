//! How the error of a view falls: what a client got when, and what error is left after so many ops.
//!
//! Batches do not say what error they leave. But a settled view does, and the server sends what matters more first, by bands of
//! a factor of two. So a [`Trace`] counts ops along bytes and time while clients run, and a [`Ladder`], made afterwards by
//! [`ladder`](super::ladder), tells which error is left after how many ops; [`ErrorCurve`] joins them over all clients traced.

use std::time::Duration;

use lodestream_protocol::view::View;
use serde::Serialize;

/// Clients that are traced, spread evenly over all.
pub(super) const MAX_TRACED: u64 = 16;
/// Views of a client that are traced.
const MAX_VIEWS: usize = 2;
/// Points of a view; when there are more, every other one goes.
const MAX_POINTS: usize = 4096;
/// Points of a curve.
const CURVE_POINTS: i32 = 64;

/// What came up to a moment.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Point {
    pub(super) after: Duration,
    pub(super) bytes: u64,
    /// Splits and components inserted.
    pub(super) ops: u64,
}

/// A view, and what came after it was set; after the client began to connect for its first.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TracedView {
    pub(super) view: View,
    origin: Point,
    /// In order; the first is when there is a mesh to look at.
    pub(super) points: Vec<Point>,
    pub(super) is_settled: bool,
}

/// The first views of a client, each up to the moment when it settled.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Trace {
    pub(super) views: Vec<TracedView>,
    is_over: bool,
}

impl Trace {
    /// Whether the client of this number is one of those traced.
    pub(super) fn includes(index: u64, clients: u32) -> bool {
        index.is_multiple_of(u64::from(clients).div_ceil(MAX_TRACED).max(1))
    }

    /// A new view is set. One that replaces another before that has settled ends the trace: where it starts from is not known.
    pub(super) fn begin(&mut self, view: &View, now: Point) {
        if self.is_over || self.views.len() == MAX_VIEWS || self.views.last().is_some_and(|view| !view.is_settled) {
            self.is_over = true;
            return;
        }
        let origin = if self.views.is_empty() { Point { ops: now.ops, ..Point::default() } } else { now };
        self.views.push(TracedView { view: view.clone(), origin, points: Vec::new(), is_settled: false });
    }

    /// What came so far, of all views together.
    pub(super) fn note(&mut self, now: Point, is_settled: bool) {
        let Some(view) = self.views.last_mut().filter(|view| !view.is_settled && !self.is_over) else { return };
        if view.points.len() >= MAX_POINTS {
            let mut number = 0;
            view.points.retain(|_| {
                number += 1;
                number % 2 == 1
            });
        }
        view.points.push(Point {
            after: now.after.saturating_sub(view.origin.after),
            bytes: now.bytes.saturating_sub(view.origin.bytes),
            ops: now.ops.saturating_sub(view.origin.ops),
        });
        view.is_settled = is_settled;
    }

    /// The views that settled.
    pub(super) fn settled(&self) -> &[TracedView] {
        let count = self.views.iter().take_while(|view| view.is_settled).count();
        &self.views[..count]
    }
}

/// The error that is left, at most, from so many ops of a view on. Ops rise, errors fall; the first rung has no ops.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Ladder {
    rungs: Vec<(u64, f32)>,
}

impl Ladder {
    /// What a settled mesh of so many ops leaves. To be called with tolerances that fall.
    pub(super) fn add(&mut self, ops: u64, error_px: f32) {
        let (last_ops, last_error) = self.rungs.last().copied().unwrap_or((0, f32::INFINITY));
        let rung = (ops.max(last_ops), error_px.min(last_error));
        match self.rungs.last_mut() {
            Some(last) if last.0 == rung.0 => *last = rung,
            _ => self.rungs.push(rung),
        }
    }

    fn error_px(&self, ops: u64) -> Option<f32> {
        let reached = self.rungs.partition_point(|rung| rung.0 <= ops);
        Some(self.rungs.get(reached.checked_sub(1)?)?.1)
    }
}

/// A point of a curve: over clients, by nearest rank.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ErrorPoint {
    /// Bytes or milliseconds.
    pub at: f64,
    /// A tenth of the clients have at most this error, in pixels.
    pub p10: f64,
    /// Half of them.
    pub p50: f64,
    /// Nine tenths.
    pub p90: f64,
}

/// Error against what it took, over the clients traced whose view settled.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ErrorCurve {
    /// How many these are.
    pub clients: usize,
    /// Against bytes received.
    pub by_bytes: Vec<ErrorPoint>,
    /// Against milliseconds.
    pub by_time_ms: Vec<ErrorPoint>,
}

impl ErrorCurve {
    /// `None` without views.
    pub(super) fn new(views: &[(&TracedView, &Ladder)]) -> Option<Self> {
        let by = |at: fn(&Point) -> f64| {
            let line = |(view, ladder): &(&TracedView, &Ladder)| -> Vec<(f64, f64)> {
                let points = view.points.iter();
                points.filter_map(|point| Some((at(point), f64::from(ladder.error_px(point.ops)?)))).collect()
            };
            quantiles(&views.iter().map(line).filter(|line| !line.is_empty()).collect::<Vec<_>>())
        };
        let by_bytes = by(|point| point.bytes as f64);
        let by_time_ms = by(|point| point.after.as_secs_f64() * 1e3);
        (!by_bytes.is_empty()).then_some(Self { clients: views.len(), by_bytes, by_time_ms })
    }
}

/// Quantiles over lines, each a step at its points, from where all of them have begun to where the last ends. Places grow by a
/// constant factor.
fn quantiles(lines: &[Vec<(f64, f64)>]) -> Vec<ErrorPoint> {
    let ends = lines.iter().filter_map(|line| line.last()).map(|point| point.0).fold(0.0, f64::max);
    let begins = lines.iter().filter_map(|line| line.first()).map(|point| point.0).fold(0.0, f64::max);
    if lines.is_empty() || ends <= 0.0 {
        return Vec::new();
    }
    let begins = begins.max(ends / 1e2);
    let factor = (ends / begins).powf(1.0 / f64::from(CURVE_POINTS - 1));
    let places = (0..CURVE_POINTS).map(|i| if i + 1 == CURVE_POINTS { ends } else { begins * factor.powi(i) });
    let mut errors = Vec::with_capacity(lines.len());
    places
        .map(|at| {
            errors.clear();
            errors.extend(lines.iter().map(|line| {
                let passed = line.partition_point(|point| point.0 <= at);
                line[passed.saturating_sub(1)].1
            }));
            errors.sort_by(f64::total_cmp);
            let rank = |share: f64| errors[((share * errors.len() as f64).ceil() as usize).clamp(1, errors.len()) - 1];
            ErrorPoint { at, p10: rank(0.1), p50: rank(0.5), p90: rank(0.9) }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    fn view(x: f64) -> View {
        View::perspective(DVec3::new(x, 0.0, 3.0), DVec3::ZERO, 0.8)
    }

    fn point(ms: u64, bytes: u64, ops: u64) -> Point {
        Point { after: Duration::from_millis(ms), bytes, ops }
    }

    #[test]
    fn clients_traced_are_spread_evenly() {
        for clients in [1, 2, 16, 17, 100, 1_000_000] {
            let traced = (0..u64::from(clients)).filter(|&index| Trace::includes(index, clients)).count() as u64;
            assert!((1..=MAX_TRACED).contains(&traced) && traced >= u64::from(clients.min(9)), "{clients}: {traced}");
        }
    }

    #[test]
    fn a_trace_counts_from_connecting_and_then_from_the_view() {
        let mut trace = Trace::default();
        trace.begin(&view(0.0), point(40, 900, 0));
        trace.note(point(50, 1000, 0), false);
        trace.note(point(60, 2000, 10), true);
        trace.note(point(70, 2100, 10), false);
        trace.begin(&view(1.0), point(100, 2500, 10));
        trace.note(point(130, 3000, 14), true);
        trace.begin(&view(2.0), point(140, 3000, 14));
        trace.note(point(150, 4000, 20), true);
        let [first, second] = trace.settled() else { panic!("two settled") };
        assert_eq!(first.points, [point(50, 1000, 0), point(60, 2000, 10)]);
        assert_eq!(second.points, [point(30, 500, 4)]);

        let mut trace = Trace::default();
        trace.begin(&view(0.0), point(40, 900, 0));
        trace.begin(&view(1.0), point(100, 2500, 10));
        trace.note(point(130, 3000, 14), true);
        assert!(trace.settled().is_empty(), "the first was replaced");

        let mut trace = Trace::default();
        trace.begin(&view(0.0), Point::default());
        (0..20_000).for_each(|i| trace.note(point(i, i, i), i == 19_999));
        let points = &trace.settled()[0].points;
        assert!(points.len() <= MAX_POINTS && points.last() == Some(&point(19_999, 19_999, 19_999)));
        assert!(points.is_sorted_by_key(|point| point.ops));
    }

    #[test]
    fn a_curve_is_the_quantile_of_the_steps_of_all_clients() {
        let mut ladder = Ladder::default();
        for (ops, error) in [(0, 9.0), (0, 8.0), (10, 4.0), (30, 1.0)] {
            ladder.add(ops, error);
        }
        assert_eq!([0, 9, 10, 29, 30, 99].map(|ops| ladder.error_px(ops)), [8.0, 8.0, 4.0, 4.0, 1.0, 1.0].map(Some));
        assert_eq!(Ladder::default().error_px(5), None);

        let mut rng = fastrand::Rng::with_seed(8);
        let views: Vec<TracedView> = (0..7)
            .map(|_| {
                let mut now = Point::default();
                let mut step = || {
                    now.after += Duration::from_millis(rng.u64(1..50));
                    now.bytes += rng.u64(1..5000);
                    now.ops += rng.u64(0..9);
                    now
                };
                let points = (0..20).map(|_| step()).collect();
                TracedView { view: view(0.0), origin: Point::default(), points, is_settled: true }
            })
            .collect();
        let pairs: Vec<_> = views.iter().map(|view| (view, &ladder)).collect();
        let curve = ErrorCurve::new(&pairs).unwrap();
        assert_eq!((curve.clients, curve.by_bytes.len(), curve.by_time_ms.len()), (7, 64, 64));
        for at in &curve.by_bytes {
            // The dull twin looks at every point of every client.
            let reached = |view: &TracedView| {
                let passed = view.points.iter().filter(|point| point.bytes as f64 <= at.at);
                ladder.error_px(passed.map(|point| point.ops).max().expect("all have begun")).unwrap()
            };
            let mut errors: Vec<f32> = views.iter().map(reached).collect();
            errors.sort_by(f32::total_cmp);
            assert_eq!([at.p10, at.p50, at.p90], [errors[0], errors[3], errors[6]].map(f64::from), "{at:?}");
        }
        assert!(curve.by_time_ms.is_sorted_by(|a, b| a.at < b.at && a.p50 >= b.p50));
        assert_eq!(ErrorCurve::new(&[]), None);
    }
}
