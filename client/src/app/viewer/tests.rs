use lodestream_protocol::ids::ViewSeq;
use lodestream_protocol::message::{ClientMessage, Resume, ServerMessage};
use lodestream_protocol::wire::{decode_client, encode_server};

use super::*;
use crate::camera::navigate::StandardView;
use crate::fake_server::{FakeServer, TOKEN};

const VIEWPORT: Viewport = Viewport { width_px: 800, height_px: 600 };

fn at(ms: u64) -> Timestamp {
    Timestamp(Duration::from_millis(ms))
}

fn requests(viewer: &mut Viewer) -> Vec<Request> {
    std::iter::from_fn(|| viewer.poll_request()).collect()
}

fn sent(viewer: &mut Viewer, now: Timestamp) -> Vec<ClientMessage> {
    std::iter::from_fn(|| viewer.poll_transmit(now)).map(|(_, frame)| decode_client(&frame).unwrap()).collect()
}

/// A viewer that has its base and a settled mesh, and its server.
fn settled() -> (Viewer, FakeServer) {
    let mut viewer = Viewer::new(ViewerOptions::new(VIEWPORT));
    viewer.tick(at(0));
    assert_eq!(requests(&mut viewer), [Request::Open(Wire::Main)]);
    assert_eq!(viewer.state(), &State::Connecting);
    let server = refine(&mut viewer, 100, 5);
    assert_eq!(viewer.state(), &State::Settled { limited: true });
    (viewer, server)
}

/// Opens the main connection to a new server, which refines in rounds and settles.
fn refine(viewer: &mut Viewer, from_ms: u64, rounds: u64) -> FakeServer {
    let mut server = FakeServer::new();
    viewer.handle_open(Wire::Main);
    assert!(matches!(sent(viewer, at(from_ms))[0], ClientMessage::Hello(_)));
    viewer.handle_frame(at(from_ms), Wire::Main, &server.welcome());
    viewer.tick(at(from_ms));
    let messages = sent(viewer, at(from_ms));
    assert!(matches!(messages[..], [ClientMessage::View { seq: ViewSeq(1), .. }]), "{messages:?}");
    for round in 0..rounds {
        viewer.handle_frame(at(from_ms + round), Wire::Main, &server.batch(ViewSeq(1), 60));
        viewer.tick(at(from_ms + round));
    }
    viewer.handle_frame(at(from_ms + rounds), Wire::Main, &server.settled(ViewSeq(1)));
    viewer.tick(at(from_ms + rounds));
    server
}

fn draw(viewer: &mut Viewer, now: Timestamp) {
    let scene = viewer.scene(now).expect("there is a mesh");
    scene.replica.dirty_mut().expect("it tracks").clear();
    viewer.note_drawn(now, &DrawStats::default());
}

#[test]
fn a_viewer_connects_refines_and_rests() {
    let (mut viewer, server) = settled();
    assert!(viewer.tick(at(300)).draw);
    draw(&mut viewer, at(300));
    sent(&mut viewer, at(300));
    let tick = viewer.tick(at(400));
    assert!(!tick.draw && tick.wake.is_none(), "nothing to do: {tick:?}");
    let figures = viewer.figures(at(400));
    assert_eq!(figures.triangles, server.replica().triangle_count());
    assert!(figures.bytes_received > 100 && figures.error_px == Some(0.5) && figures.memory_bytes > 0);
    // A camera that moves asks for another view and is drawn.
    viewer.command(at(500), Command::View(StandardView::Top));
    viewer.tick(at(700));
    assert!(matches!(sent(&mut viewer, at(700))[..], [ClientMessage::View { .. }]));
    let tick = viewer.tick(at(716));
    assert!(tick.draw && tick.wake == Some(at(716)));
    assert_eq!(viewer.state().name(), "refining");
}

#[test]
fn a_hint_saves_a_round_trip_and_an_early_hello_another() {
    let hint = Hint { bounds: Bounds { center: DVec3::ZERO, radius: 1.0 }, smallest_limit: 4 };
    let options = ViewerOptions { hint: Some(hint), ..ViewerOptions::new(VIEWPORT) };
    let mut other = Viewer::new(options.clone());
    other.tick(at(0));
    other.handle_open(Wire::Main);
    let (_, hello) = other.poll_transmit(at(1)).unwrap();
    let mut viewer = Viewer::new(options.clone());
    assert!(viewer.adopt(at(5), &hello));
    viewer.tick(at(5));
    assert_eq!(requests(&mut viewer), []);
    assert!(matches!(sent(&mut viewer, at(5))[..], [ClientMessage::View { .. }]), "before the welcome");
    // A link that asks for something else in the hello.
    let mut viewer = Viewer::new(ViewerOptions { link: "rate=5000".into(), ..options });
    assert!(!viewer.adopt(at(5), &hello));
    viewer.tick(at(5));
    assert_eq!(requests(&mut viewer), [Request::Open(Wire::Main)]);
}

#[test]
fn the_picture_stays_until_the_new_mesh_is_as_good() {
    let (mut viewer, server) = settled();
    draw(&mut viewer, at(300));
    let triangles = server.replica().triangle_count();
    viewer.handle_end(at(400), Wire::Main, &Ending::Lost);
    let tick = viewer.tick(at(401));
    assert_eq!(viewer.state(), &State::Reconnecting);
    assert_eq!(viewer.figures(at(401)).triangles, triangles);
    let wake = tick.wake.expect("it tries again");
    viewer.tick(wake);
    assert_eq!(requests(&mut viewer), [Request::Open(Wire::Main)]);

    let mut server = FakeServer::new();
    viewer.handle_open(Wire::Main);
    assert!(matches!(sent(&mut viewer, at(2000))[0], ClientMessage::Resume(_)));
    viewer.handle_frame(at(2001), Wire::Main, &server.welcome());
    viewer.handle_frame(at(2002), Wire::Main, &server.batch(ViewSeq(1), 4));
    viewer.tick(at(2003));
    assert_eq!(viewer.figures(at(2003)).triangles, triangles, "the base is no improvement");
    assert_eq!(viewer.state().name(), "refining");
    while server.replica().triangle_count() < triangles {
        viewer.handle_frame(at(2010), Wire::Main, &server.batch(ViewSeq(1), 60));
        viewer.tick(at(2011));
    }
    assert!(viewer.tick(at(2012)).draw, "another mesh");
    assert_eq!(viewer.figures(at(2012)).triangles, server.replica().triangle_count());
    let scene = viewer.scene(at(2012)).unwrap();
    let all = scene.replica.dirty_mut().unwrap().vertex_ranges(0);
    assert_eq!(all[0].start, 0, "whoever draws it begins anew");
}

#[test]
fn a_session_goes_on_over_the_next_connection() {
    let (mut viewer, mut server) = settled();
    draw(&mut viewer, at(300));
    let (triangles, generation) = (server.replica().triangle_count(), viewer.session.generation());
    // What has arrived is not asked for again, whether it was applied or not.
    viewer.handle_frame(at(399), Wire::Main, &server.batch(ViewSeq(1), 20));
    viewer.handle_end(at(400), Wire::Main, &Ending::Lost);
    viewer.handle_end(at(400), Wire::Main, &Ending::Lost);
    let wake = viewer.tick(at(401)).wake.expect("it tries again");
    assert_eq!(viewer.state(), &State::Reconnecting);
    assert!(wake <= at(660), "{wake:?}");
    viewer.tick(at(660));
    requests(&mut viewer);
    viewer.handle_open(Wire::Main);
    let messages = sent(&mut viewer, at(700));
    let [ClientMessage::Resume(resume), ClientMessage::View { seq: ViewSeq(1), .. }] = &messages[..] else {
        panic!("{messages:?}")
    };
    assert_eq!((resume.token, resume.received), (TOKEN, Some(server.seq())));
    viewer.handle_frame(at(710), Wire::Main, &encode_server(&ServerMessage::Resumed { token: TOKEN }));
    viewer.handle_frame(at(711), Wire::Main, &server.settled(ViewSeq(1)));
    viewer.tick(at(712));
    assert_eq!(viewer.state(), &State::Settled { limited: true });
    assert!(server.replica().triangle_count() > triangles);
    assert_eq!(viewer.figures(at(712)).triangles, server.replica().triangle_count());
    assert_eq!(viewer.session.generation(), generation, "no new picture");
    assert_eq!(viewer.session.stats().resumed, 1);
}

#[test]
fn nonsense_makes_the_session_begin_anew() {
    let (mut viewer, server) = settled();
    draw(&mut viewer, at(300));
    viewer.handle_frame(at(500), Wire::Main, &[9, 9, 9]);
    viewer.tick(at(1000));
    assert_eq!(requests(&mut viewer), [Request::Close(Wire::Main), Request::Open(Wire::Main)]);
    assert_eq!(viewer.figures(at(1000)).triangles, server.replica().triangle_count(), "what was seen is still there");
    viewer.handle_open(Wire::Main);
    assert!(matches!(sent(&mut viewer, at(1001))[0], ClientMessage::Hello(_)));
    viewer.handle_frame(at(1002), Wire::Main, &FakeServer::new().welcome());
    viewer.tick(at(1003));
    assert_eq!(viewer.state().name(), "refining");
}

#[test]
fn endings_are_told_apart() {
    for (ending, name) in [
        (Ending::NoSuchModel, "gone"),
        (Ending::Full, "full"),
        (Ending::Refused("no".into()), "failed"),
        (Ending::Closed { code: 4001, reason: String::new() }, "failed"),
    ] {
        let mut viewer = Viewer::new(ViewerOptions::new(VIEWPORT));
        viewer.tick(at(0));
        viewer.handle_end(at(1), Wire::Main, &ending);
        viewer.tick(at(2));
        assert_eq!(viewer.state().name(), name);
    }
    let (mut viewer, _) = settled();
    requests(&mut viewer);
    viewer.handle_frame(at(500), Wire::Main, &[9, 9, 9]);
    viewer.tick(at(501));
    assert_eq!(requests(&mut viewer), [Request::Close(Wire::Main)]);
    assert_eq!(viewer.state(), &State::Reconnecting);
    assert!(viewer.replica().is_some(), "what was seen is still there");
}

#[test]
fn uploads_stop_at_the_allowance_and_go_on_with_the_next_image() {
    let (mut viewer, mut server) = settled();
    draw(&mut viewer, at(300));
    viewer.allowance.bytes = 20_000;
    for _ in 0..40 {
        viewer.handle_frame(at(400), Wire::Main, &server.batch(ViewSeq(1), 20));
    }
    let mut images = 0;
    while viewer.figures(at(400)).triangles < server.replica().triangle_count() {
        let before = viewer.session.stats().batches;
        let tick = viewer.tick(at(400 + images));
        assert!(tick.draw && tick.wake.is_some());
        assert!(viewer.session.stats().batches > before, "each image brings something");
        draw(&mut viewer, at(400 + images));
        images += 1;
    }
    assert!(images > 3, "{images}");
}

#[test]
fn a_batch_over_the_allowance_has_an_image_to_itself() {
    let (mut viewer, mut server) = settled();
    draw(&mut viewer, at(300));
    viewer.allowance.bytes = 3000;
    let before = viewer.session.stats().batches;
    for splits in [1, 100, 1] {
        viewer.handle_frame(at(400), Wire::Main, &server.batch(ViewSeq(1), splits));
    }
    let mut images = Vec::new();
    for k in 0..3 {
        assert!(viewer.tick(at(401 + k)).draw);
        let is_over = viewer.planned_bytes() > Some(viewer.allowance.bytes);
        images.push((viewer.session.stats().batches - before, is_over));
        draw(&mut viewer, at(401 + k));
    }
    assert_eq!(images, [(1, false), (2, true), (3, false)], "batches applied, and whether they are too much");
    assert_eq!(viewer.figures(at(404)).triangles, server.replica().triangle_count());
}

#[test]
fn crevices_grow_dark_once_nothing_lies_over_the_image() {
    // The model has colours, with which they are off by themselves.
    let options = ViewerOptions { is_covered: true, link: "occlusion=on".into(), ..ViewerOptions::new(VIEWPORT) };
    let mut viewer = Viewer::new(options);
    viewer.tick(at(0));
    refine(&mut viewer, 100, 5);
    let drawn = |viewer: &mut Viewer, ms: u64| {
        let scene = viewer.scene(at(ms)).expect("there is a mesh");
        scene.replica.dirty_mut().expect("it tracks").clear();
        let occlusion = scene.options.occlusion;
        viewer.note_drawn(at(ms), &DrawStats { has_occlusion: occlusion > 0.0, ..DrawStats::default() });
        occlusion
    };
    let hidden = drawn(&mut viewer, 300);
    assert!(hidden > 0.0 && hidden < 1.0 / 255.0, "{hidden}: what draws them is there, and is not to be seen");
    assert!(!viewer.tick(at(400)).draw, "nothing changes");
    viewer.uncover(at(500));
    let mut before = hidden;
    for ms in (516..1100).step_by(16) {
        assert!(viewer.tick(at(ms)).draw);
        let next = drawn(&mut viewer, ms);
        assert!(next >= before && next - before < 0.05, "{before}, then {next}");
        before = next;
    }
    assert!(viewer.tick(at(1100)).draw);
    let whole = drawn(&mut viewer, 1100);
    assert!(!viewer.tick(at(1200)).draw, "it is over");
    viewer.uncover(at(1300));
    assert!(!viewer.tick(at(1300)).draw, "only once");
    assert_eq!(viewer.settings().render_options(true, 45.0, None, true).occlusion, whole);
    // Where there are none, nothing is drawn for them.
    let mut viewer = Viewer::new(ViewerOptions { is_covered: true, ..ViewerOptions::new(VIEWPORT) });
    viewer.tick(at(0));
    refine(&mut viewer, 100, 5);
    assert_eq!(drawn(&mut viewer, 300), 0.0);
    viewer.uncover(at(500));
    assert!(viewer.tick(at(501)).draw);
    drawn(&mut viewer, 501);
    assert!(!viewer.tick(at(516)).draw);
}

#[test]
fn limits_follow_settings_memory_and_the_model() {
    let (mut viewer, _) = settled();
    let mut limit = |key: &str, value: &str| {
        viewer.command(at(500), Command::Set { key: key.into(), value: value.into() });
        viewer.figures(at(500)).limit
    };
    assert_eq!(limit("triangles", "auto"), 1_000_000);
    assert_eq!(limit("triangles", "5000"), 5000);
    assert_eq!(limit("triangles", "90000000"), (1u32 << 30) / 160, "automatic memory is a GiB");
    assert_eq!(limit("memory", "16"), (16 << 20) / 160);
    viewer.command(at(600), Command::Set { key: "rate".into(), value: "9000".into() });
    viewer.tick(at(600));
    assert_eq!(requests(&mut viewer), [Request::Close(Wire::Main), Request::Open(Wire::Main)]);
    viewer.handle_open(Wire::Main);
    let first = sent(&mut viewer, at(601)).remove(0);
    assert!(matches!(first, ClientMessage::Resume(Resume { hello, .. }) if hello.byte_rate == Some(9000)), "{first:?}");
    viewer.command(at(700), Command::Set { key: "rate".into(), value: "much".into() });
    assert!(matches!(viewer.poll_event(), Some(Event::Notice(text)) if text.contains("much")));
}

#[test]
fn a_pick_is_answered_at_once_and_then_exactly() {
    let (mut viewer, server) = settled();
    requests(&mut viewer);
    sent(&mut viewer, at(400));
    let Some(pixel) = (0..48)
        .map(|k| [100.0 + 80.0 * f64::from(k % 8), 50.0 + 100.0 * f64::from(k / 8)])
        .find(|&pixel| viewer.surface_at(pixel).is_some())
    else {
        panic!("the mesh is nowhere on screen")
    };
    viewer.command(at(500), Command::Pick(pixel));
    assert_eq!(viewer.poll_event(), Some(Event::Marked));
    let quick = viewer.marks()[0];
    assert!(!quick.is_exact && viewer.distance().is_none());
    assert_eq!(requests(&mut viewer), [Request::Open(Wire::Probe)]);
    viewer.handle_open(Wire::Probe);
    viewer.tick(at(510));
    let hello = sent(&mut viewer, at(510));
    assert!(matches!(hello[..], [ClientMessage::Hello(_)]), "{hello:?}");
    // The probe's server has its own session, whose mesh is that of the main one here.
    viewer.handle_frame(at(520), Wire::Probe, &FakeServer::new().welcome());
    viewer.tick(at(520));
    let view = sent(&mut viewer, at(520));
    let [ClientMessage::View { seq, view }] = &view[..] else { panic!("{view:?}") };
    assert_eq!((view.tolerance_px, view.viewport_height_px), (0.0, 3));
    drop(server);
    let mut other = FakeServer::new();
    for _ in 0..5 {
        viewer.handle_frame(at(525), Wire::Probe, &other.batch(*seq, 60));
    }
    viewer.handle_frame(at(530), Wire::Probe, &other.settled(*seq));
    viewer.tick(at(531));
    let mark = viewer.marks()[0];
    assert_eq!((mark.point, mark.is_exact), (quick.point, false), "the limit kept something out: not exact");
    assert_eq!(viewer.poll_event(), Some(Event::Marked));
    // Unused for a while, the connection goes.
    viewer.tick(at(60_000));
    assert!(requests(&mut viewer).contains(&Request::Close(Wire::Probe)));
}

#[test]
fn links_and_keys_lead_where_they_say() {
    let (mut viewer, _) = settled();
    assert!(viewer.key(at(500), "Digit1", true, false) && !viewer.key(at(500), "F9", true, false));
    viewer.tick(at(2000));
    viewer.tick(at(2001));
    let link = viewer.link().unwrap();
    assert!(link.contains("from=0,0,"), "{link}");
    assert!(viewer.key(at(2002), "ArrowLeft", true, false) && viewer.key(at(2003), "KeyO", true, false));
    viewer.tick(at(2010));
    assert_ne!(viewer.link().unwrap(), link);
    viewer.command(at(2020), Command::Open(format!("#{link}")));
    viewer.tick(at(2021));
    assert_eq!(viewer.link().unwrap(), link);
    // A key that was held when the window lost the keyboard moves nothing.
    viewer.key(at(2030), "KeyW", true, false);
    viewer.cancel(at(2031));
    for k in 0..200 {
        viewer.tick(at(2040 + 16 * k));
    }
    assert!(!viewer.is_moving());
    for name in ["view", "pick", "focus"] {
        assert_eq!(Command::parse(name, "nonsense"), None, "{name}");
    }
}
