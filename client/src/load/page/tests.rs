use std::time::Duration;

use fastrand::Rng;

use super::*;
use crate::camera::{Detail, Viewport};
use crate::load::LoadOptions;
use crate::load::drops::Drops;
use crate::load::duty::Duty;
use crate::load::metrics::{Reading, ServerFigures};
use crate::load::pace::Pace;
use crate::load::path::{Path, PathFile};
use crate::load::totals::{Interval, Totals};
use crate::net::link::LinkShape;

/// What someone may send who wishes us ill.
const HOSTILE: &str = "</title><script src='http://x/y.js'>&\"\u{1}\u{ffff}";

fn options() -> LoadOptions {
    LoadOptions {
        target: "http://h:1/models/x".parse().unwrap(),
        clients: 3,
        ramp: Duration::from_secs(1),
        duration: None,
        path: Path::Jump,
        path_file: Some(PathFile { name: HOSTILE.into(), xxh3: "0123".into(), views: 5 }),
        pace: Pace::Settled,
        duty: Duty::ALWAYS,
        viewport: Viewport { width_px: 640, height_px: 480 },
        fov_y_rad: 0.8,
        detail: Detail::default(),
        shape: LinkShape::default(),
        drops: Some(Drops::Share(0.25)),
        seed: 77,
        threads: 0,
        has_error_curves: true,
    }
}

fn totals() -> Totals {
    let mut totals = Totals { started: 3, connected: 3, completed: 3, ..Totals::default() };
    let mut rng = Rng::with_seed(9);
    for _ in 0..50 {
        totals.connect.add(rng.u64(100..9000));
        totals.first_image.add(rng.u64(1000..90_000));
        totals.view_to_first_op.add(rng.u64(100..90_000));
        totals.stale_bytes.add(rng.u64(0..5000));
        totals.timeline.add(
            Duration::from_millis(rng.u64(0..5000)),
            &Interval { bytes_in: 5000, splits: 10, samples: 1, triangles: 900, ..Interval::default() },
        );
    }
    totals.moving.splits = 1000;
    totals.moving.op_bytes = 4000;
    totals.moving.payload_in = 5000;
    totals.moving.bytes_in = 6000;
    totals.model = Some(HOSTILE.into());
    totals.fail(HOSTILE.into());
    totals
}

fn curve() -> ErrorCurve {
    let points = |to: f64| {
        let point = |i: u32| (to * f64::from(i), 100.0 / f64::from(i));
        (1..20).map(point).map(|(at, p50)| ErrorPoint { at, p10: p50 / 2.0, p50, p90: p50 * 2.0 }).collect()
    };
    ErrorCurve { clients: 3, by_bytes: points(1e4), by_time_ms: points(50.0) }
}

fn figures() -> ServerFigures {
    let reading = |i: u8| Reading {
        at_s: f64::from(i),
        cpu_s: f64::from(i) * 0.3,
        resident_bytes: 1e8,
        session_bytes: 1e6 * f64::from(i),
        sessions: 3.0,
        ..Reading::default()
    };
    ServerFigures::new((0..6).map(reading).collect(), 3, Duration::from_secs(15)).unwrap()
}

/// Whether tags nest, attributes are quoted and ampersands begin entities, as in XML.
fn check_well_formed(page: &str) {
    let mut open: Vec<&str> = Vec::new();
    let mut rest = page.strip_prefix("<!DOCTYPE html>").expect("it begins so");
    while let Some(start) = rest.find('<') {
        check_text(&rest[..start]);
        // Not in quotes.
        let mut is_quoted = false;
        let end = rest[start..].find(|c: char| {
            is_quoted ^= c == '"';
            c == '>' && !is_quoted
        });
        let tag = &rest[start + 1..start + end.expect("a tag ends")];
        rest = &rest[start + tag.len() + 2..];
        assert!(!tag.contains('<') && tag.matches('"').count().is_multiple_of(2), "{tag}");
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop(), Some(name), "{tag}");
        } else if !tag.ends_with('/') {
            open.push(tag.split_whitespace().next().expect("a tag has a name"));
        }
        check_text(tag);
    }
    assert!(open.is_empty() && rest.trim().is_empty(), "{open:?} {rest}");
}

fn check_text(text: &str) {
    for (at, _) in text.match_indices('&') {
        let name = text[at + 1..].split(';').next().unwrap_or_default();
        assert!(["amp", "lt", "gt", "quot", "apos", "#39"].contains(&name), "{}", &text[at..]);
    }
    assert!(
        !text.chars().any(|c| c.is_control() && c != '\n' && c != '\t' && c != '\r' || c == '\u{ffff}'),
        "{text:?}"
    );
}

/// Nothing is loaded from anywhere, nothing runs. Names of XML namespaces are no addresses.
fn check_stands_alone(page: &str) {
    let page = page.replace("xmlns=\"http://www.w3.org/2000/svg\"", "");
    for text in
        ["<script", "<link", "<img", "<iframe", "<use", "href", "src=\"", "url(", "@import", " onload", "=\"http"]
    {
        assert!(!page.contains(text), "{text}");
    }
}

#[test]
fn a_full_page_has_all_plots_and_stands_alone() {
    let mut report = Report::new(&options(), &totals(), Duration::from_secs(6), Ok(figures()));
    report.first_view_error = Some(curve());
    report.second_view_error = Some(curve());
    report.error_curves_missing = Some(HOSTILE.into());
    let page = html(&report).unwrap();
    check_well_formed(&page);
    check_stands_alone(&page);
    for title in [
        "Error against bytes, first view",
        "Error against time, first view",
        "Error against bytes, second view",
        "Error against time, second view",
        "Times",
        "Bytes by kind",
        "Ops by kind",
        "Received by all clients",
        "Triangles",
        "Processor time of the server",
        "Memory of the server",
    ] {
        assert!(page.contains(title), "{title}");
    }
    assert_eq!(page.matches("<svg").count(), 12);
    assert!(page.matches("<polyline").count() > 20, "axes and lines");
    // Both bands of both views.
    assert!(page.matches("<polygon").count() >= 4);
    for text in ["&lt;/title&gt;&lt;script", "XXH3 0123", "<td>seed</td>\n<td>77</td>", "clients per core"] {
        assert!(page.contains(text), "{text}");
    }
    assert_eq!(html(&report).unwrap(), page, "the same figures give the same page");
}

#[test]
fn a_page_without_figures_says_why() {
    let report = Report::new(&options(), &Totals::default(), Duration::ZERO, Err(HOSTILE.into()));
    let page = html(&report).unwrap();
    check_well_formed(&page);
    check_stands_alone(&page);
    assert!(page.contains("No figures: &lt;/title&gt;") && !page.contains("Memory of the server"));
}
