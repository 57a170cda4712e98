use glam::DVec3;
use lodestream_protocol::ids::ModelHash;
use lodestream_protocol::message::{Batch, ClientMessage};
use lodestream_protocol::testing::check_replica;
use lodestream_protocol::wire::{decode_client, encode_server};

use super::apply::MAX_RESETS;
use super::*;
use crate::fake_server::{FakeServer, TOKEN};

fn at(ms: u64) -> Timestamp {
    Timestamp(Duration::from_millis(ms))
}

fn view(x: f64) -> View {
    View::perspective(DVec3::new(x, 0.0, 10.0), DVec3::ZERO, 0.8)
}

fn sent(session: &mut ClientSession, now: Timestamp) -> Vec<ClientMessage> {
    std::iter::from_fn(|| session.poll_transmit(now)).map(|frame| decode_client(&frame).unwrap()).collect()
}

/// A session that has said hello and has its base, and its server.
fn welcomed(config: ClientConfig) -> (ClientSession, FakeServer) {
    let server = FakeServer::new();
    let mut session = ClientSession::new(config);
    session.set_view(at(0), view(0.0)).unwrap();
    assert_eq!(sent(&mut session, at(0)).len(), 2);
    session.handle_frame(at(10), &server.welcome()).unwrap();
    (session, server)
}

fn assert_equal(session: &ClientSession, server: &FakeServer) {
    let replica = session.replica().unwrap();
    assert_eq!(replica.digest(), server.replica().digest());
    check_replica(replica).unwrap();
}

#[test]
fn hello_and_the_first_view_go_out_at_once() {
    let mut session = ClientSession::new(ClientConfig { byte_rate: Some(9), ..ClientConfig::default() });
    assert_eq!(session.poll_timeout(), None);
    session.set_view(at(0), view(1.0)).unwrap();
    let messages = sent(&mut session, at(0));
    let hello = Hello { version: PROTOCOL_VERSION, triangle_limit: 1_000_000, cache_entries: None, byte_rate: Some(9) };
    let first = ClientMessage::View { seq: ViewSeq(1), view: view(1.0) };
    assert_eq!(messages, [ClientMessage::Hello(hello), first]);
    assert!(session.replica().is_none() && session.model().is_none());
    assert_eq!(session.generation(), 0);
}

#[test]
fn batches_are_applied_and_acknowledged() {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    assert_eq!(session.model().unwrap().title, "tetrahedron");
    assert_eq!(session.stats().triangles, 4);
    for round in 1..=5 {
        session.handle_frame(at(20), &server.batch(ViewSeq(1), 30)).unwrap();
        assert_equal(&session, &server);
        assert_eq!(sent(&mut session, at(20)), [ClientMessage::Ack { seq: BatchSeq(round) }]);
    }
    let stats = session.stats();
    assert_eq!((stats.batches, stats.frames, stats.resets), (5, 6, 0));
    assert_eq!(stats.splits, 4 + 8 + 16 + 30 + 30);
    assert_eq!(stats.triangles, 4 + 2 * 88);
    assert_eq!(stats.view_latency_ms, Some(20.0));
    assert_eq!(stats.error_px, Some(2.5));
    // Several batches between two polls make one ack.
    for _ in 0..3 {
        session.handle_frame(at(30), &server.batch(ViewSeq(1), 1)).unwrap();
    }
    assert_eq!(sent(&mut session, at(30)), [ClientMessage::Ack { seq: BatchSeq(8) }]);
}

#[test]
fn collapses_and_cached_splits_are_counted() {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    session.handle_frame(at(20), &server.batch(ViewSeq(1), 4)).unwrap();
    let batch = server.batch_message(ViewSeq(1), true, 4);
    session.handle_frame(at(21), &encode_server(&ServerMessage::Batch(batch))).unwrap();
    assert_equal(&session, &server);
    let stats = session.stats();
    assert!(stats.collapses > 0 && stats.cached_splits > 0, "{stats:?}");
    assert!(stats.max_triangles_seen >= stats.triangles);
}

#[test]
fn only_the_newest_view_settles() {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    session.handle_frame(at(20), &server.batch(ViewSeq(1), 4)).unwrap();
    session.handle_frame(at(21), &server.settled(ViewSeq(1))).unwrap();
    assert_eq!(session.settled().unwrap().outcome.error_px, 0.5);
    let stats = session.stats();
    assert!(stats.settled && stats.limited);
    assert_eq!((stats.settled_ms, stats.error_px), (Some(21.0), Some(0.5)));

    session.set_view(at(30), view(0.0)).unwrap();
    assert!(session.settled().is_some(), "the same view again changes nothing");
    let seq = session.set_view(at(40), view(2.0)).unwrap();
    assert!(session.settled().is_none() && !session.stats().settled && session.stats().settled_ms.is_none());
    session.handle_frame(at(41), &server.settled(ViewSeq(1))).unwrap();
    assert!(session.settled().is_none(), "settled for a view that is not the newest");
    session.handle_frame(at(42), &server.settled(seq)).unwrap();
    assert_eq!(session.stats().settled_ms, Some(42.0));
}

#[test]
fn the_first_image_needs_2000_triangles_or_a_settled_view() {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    session.handle_frame(at(20), &server.batch(ViewSeq(1), 4)).unwrap();
    assert_eq!(session.stats().first_image_ms, None);
    session.note_traffic(700, 90);
    session.handle_frame(at(25), &server.settled(ViewSeq(1))).unwrap();
    assert_eq!((session.stats().first_image_ms, session.stats().first_image_bytes), (Some(25.0), Some(700)));

    let (mut session, mut server) = welcomed(ClientConfig::default());
    let mut now = 30;
    while session.stats().triangles < FIRST_IMAGE_TRIANGLES {
        assert_eq!(session.stats().first_image_ms, None);
        now += 1;
        session.note_traffic(10 * now, 0);
        session.handle_frame(at(now), &server.batch(ViewSeq(1), 100_000)).unwrap();
    }
    session.handle_frame(at(now + 1), &server.batch(ViewSeq(1), 100_000)).unwrap();
    assert_eq!(session.stats().first_image_ms, Some(now as f64));
    assert_eq!(session.stats().first_image_bytes, Some(10 * now));
}

#[test]
fn views_are_coalesced_and_paced() {
    let (mut session, _) = welcomed(ClientConfig::default());
    // The first view went out at 0.
    session.set_view(at(5), view(1.0)).unwrap();
    session.set_view(at(6), view(2.0)).unwrap();
    assert_eq!(sent(&mut session, at(6)), []);
    assert_eq!(session.poll_timeout(), Some(at(33)));
    session.set_view(at(32), view(3.0)).unwrap();
    assert_eq!(sent(&mut session, at(32)), []);
    assert_eq!(sent(&mut session, at(33)), [ClientMessage::View { seq: ViewSeq(4), view: view(3.0) }]);
    assert_eq!(session.poll_timeout(), None);
    assert_eq!(sent(&mut session, at(500)), []);
    // After a pause a view goes out at once.
    session.set_view(at(600), view(4.0)).unwrap();
    assert_eq!(sent(&mut session, at(600)).len(), 1);
    let mut nonsense = view(5.0);
    nonsense.near = -1.0;
    assert!(session.set_view(at(700), nonsense).is_err());
    assert_eq!(session.view().unwrap().0, ViewSeq(5));
}

/// Sends the damaged frame and follows the session through reset and restart.
fn check_recovery(damage: impl FnOnce(&mut Batch)) {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    session.replica_mut().unwrap().track_dirty();
    session.handle_frame(at(20), &server.batch(ViewSeq(1), 4)).unwrap();
    sent(&mut session, at(20));
    let mut batch = server.batch_message(ViewSeq(1), false, 8);
    damage(&mut batch);
    let seq = BatchSeq(2);
    session.handle_frame(at(21), &encode_server(&ServerMessage::Batch(batch))).unwrap();
    assert_eq!(sent(&mut session, at(21)), [ClientMessage::Reset { seq }]);
    assert_eq!(session.stats().resets, 1);
    // What the server had on the way means nothing any more.
    session.handle_frame(at(22), &server.batch(ViewSeq(1), 1)).unwrap();
    session.handle_frame(at(22), &server.settled(ViewSeq(1))).unwrap();
    assert_eq!(sent(&mut session, at(22)), []);
    assert_eq!(session.stats().dropped_batches, 1);
    assert!(session.settled().is_none());

    session.handle_frame(at(30), &server.restart()).unwrap();
    assert_eq!(session.generation(), 2);
    assert_equal(&session, &server);
    let dirty = session.replica_mut().unwrap().dirty_mut().expect("still tracked");
    assert_eq!(dirty.vertex_ranges(0).first(), Some(&(0..4)));
    session.handle_frame(at(31), &server.batch(ViewSeq(1), 4)).unwrap();
    assert_equal(&session, &server);
    assert_eq!(sent(&mut session, at(31)), [ClientMessage::Ack { seq: BatchSeq(1) }]);
    session.handle_frame(at(32), &server.settled(ViewSeq(1))).unwrap();
    assert!(session.settled().is_some());
    assert_eq!(session.stats().resets, 1);
}

#[test]
fn a_digest_mismatch_asks_for_a_reset() {
    check_recovery(|batch| batch.digest ^= 1);
}

#[test]
fn a_batch_that_does_not_decode_asks_for_a_reset() {
    check_recovery(|batch| batch.ops.extend([1, 2, 3, 4, 5]));
}

#[test]
fn a_batch_over_its_limit_asks_for_a_reset() {
    check_recovery(|batch| batch.limit = Some(5));
}

#[test]
fn a_gap_in_the_numbers_asks_for_a_reset() {
    check_recovery(|batch| batch.seq += 1);
}

#[test]
fn endless_disagreement_ends_the_session() {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    for _ in 0..MAX_RESETS {
        let mut batch = server.batch_message(ViewSeq(1), false, 4);
        batch.digest ^= 1;
        session.handle_frame(at(20), &encode_server(&ServerMessage::Batch(batch))).unwrap();
        session.handle_frame(at(20), &server.restart()).unwrap();
    }
    let mut batch = server.batch_message(ViewSeq(1), false, 4);
    batch.digest ^= 1;
    let error = session.handle_frame(at(21), &encode_server(&ServerMessage::Batch(batch))).unwrap_err();
    assert_eq!(error.to_string(), "client and server disagreed about the mesh 5 times");
}

#[test]
fn frames_that_make_no_sense_end_the_session() {
    let fails = |frame: &[u8]| ClientSession::new(ClientConfig::default()).handle_frame(at(0), frame).unwrap_err();
    let mut server = FakeServer::new();
    assert!(matches!(fails(&[]), ClientError::Wire(_)));
    assert!(matches!(fails(&[200, 1, 2]), ClientError::Wire(_)));
    assert!(matches!(fails(&server.batch(ViewSeq(1), 1)), ClientError::OutOfTurn(_)));
    let welcome = |change: &dyn Fn(&mut ModelInfo, &mut u32, &mut Vec<u8>)| {
        let ServerMessage::Welcome { mut model, mut cache_entries, mut base, .. } =
            wire::decode_server(&FakeServer::new().welcome()).unwrap()
        else {
            unreachable!("it is a welcome")
        };
        change(&mut model, &mut cache_entries, &mut base);
        fails(&encode_server(&ServerMessage::Welcome { model, cache_entries, token: None, base }))
    };
    assert!(matches!(welcome(&|m, _, _| m.lattice.step = f64::NAN), ClientError::BadModel("lattice")));
    assert!(matches!(welcome(&|m, _, _| m.lattice.bits = 200), ClientError::BadModel("lattice")));
    assert!(matches!(welcome(&|m, _, _| m.box_max[1] = 4096), ClientError::BadModel("box")));
    assert!(matches!(welcome(&|m, _, _| m.title = "x".repeat(2000)), ClientError::BadModel("title")));
    assert!(matches!(welcome(&|_, c, _| *c = u32::MAX), ClientError::BadModel("cache size")));
    assert!(matches!(welcome(&|_, _, b| b.extend([9; 9])), ClientError::BadBase(_)));

    let (mut session, server) = welcomed(ClientConfig::default());
    assert!(matches!(session.handle_frame(at(20), &server.welcome()), Err(ClientError::OutOfTurn(_))));
}

#[test]
fn a_slow_renderer_applies_within_its_allowance_and_stops_the_reader() {
    let config = ClientConfig { apply_on_arrival: false, inbox_bytes: 100, ..ClientConfig::default() };
    let (mut session, mut server) = welcomed(config);
    let mut frames = 0;
    while session.has_room() {
        session.handle_frame(at(20), &server.batch(ViewSeq(1), 4)).unwrap();
        frames += 1;
    }
    session.apply_ready(at(21), 0).unwrap();
    assert_eq!(session.stats().batches, 0);
    assert!(matches!(session.handle_frame(at(21), &server.settled(ViewSeq(1))), Err(ClientError::InboxFull)));
    assert_eq!(session.apply_ready(at(22), 1).unwrap(), 4, "a batch is applied whole");
    assert_eq!(session.stats().batches, 1);
    assert_eq!(sent(&mut session, at(22)), [ClientMessage::Ack { seq: BatchSeq(1) }]);
    session.apply_ready(at(23), u32::MAX).unwrap();
    assert!(!session.has_ready() && session.has_room());
    assert_eq!(session.stats().batches, frames);
    assert_equal(&session, &server);
}

fn resumed() -> Vec<u8> {
    encode_server(&ServerMessage::Resumed { token: Token([9; 16]) })
}

/// The claim of the first message after a loss, and whether the view follows.
fn claim(session: &mut ClientSession, now: Timestamp) -> (Token, Option<BatchSeq>) {
    let messages = sent(session, now);
    assert!(matches!(messages[1..], [ClientMessage::View { seq: ViewSeq(1), .. }]), "{messages:?}");
    match messages[0] {
        ClientMessage::Resume(Resume { hello, token, received }) => {
            assert_eq!(hello.version, PROTOCOL_VERSION);
            (token, received)
        }
        ref other => panic!("{other:?}"),
    }
}

#[test]
fn a_broken_connection_is_made_anew_and_the_session_goes_on() {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    assert_eq!(session.connectivity(), Connectivity::Connected);
    for _ in 0..3 {
        session.handle_frame(at(20), &server.batch(ViewSeq(1), 20)).unwrap();
    }
    // A batch that the client has not got yet, and the acknowledgement of those before does not go out.
    let late = server.batch(ViewSeq(1), 20);
    session.handle_loss(at(30));
    let Connectivity::Reconnecting { attempt: 1, next_try } = session.connectivity() else { panic!() };
    assert!(next_try > at(30) && session.replica().is_some());
    session.handle_loss(next_try);
    assert!(matches!(session.connectivity(), Connectivity::Reconnecting { attempt: 2, .. }));
    assert_eq!(claim(&mut session, at(2000)), (TOKEN, Some(BatchSeq(3))));
    assert!(
        matches!(session.handle_frame(at(2001), &late), Err(ClientError::OutOfTurn(_))),
        "nothing before the answer"
    );
    session.handle_frame(at(2002), &resumed()).unwrap();
    assert!(session.is_resumed() && !session.is_restarting());
    session.handle_frame(at(2003), &late).unwrap();
    assert_equal(&session, &server);
    assert_eq!(sent(&mut session, at(2003)), [ClientMessage::Ack { seq: BatchSeq(4) }]);
    let stats = session.stats();
    assert_eq!((stats.connections_lost, stats.resumed, stats.restarted, stats.resets), (1, 1, 0, 0));
    assert_eq!(session.generation(), 1, "the same mesh all along");
    // The newest token is shown the next time.
    session.handle_loss(at(8000));
    assert_eq!(claim(&mut session, at(9000)), (Token([9; 16]), Some(BatchSeq(4))));
    assert!(matches!(session.connectivity(), Connectivity::Reconnecting { attempt: 1, .. }));
}

/// Tries of half a minute against a server whose connections break so long after its answer, which brings all that was asked for.
fn tries_in_half_a_minute(lifetime: Duration) -> u32 {
    let (mut session, server) = welcomed(ClientConfig::default());
    let (mut now, mut tries) = (at(10), 0);
    while now < at(30_010) {
        session.handle_frame(now, &server.settled(ViewSeq(1))).unwrap();
        now = now + lifetime;
        session.handle_loss(now);
        let Connectivity::Reconnecting { next_try, .. } = session.connectivity() else { panic!() };
        now = next_try;
        assert_eq!(claim(&mut session, now).1, Some(BatchSeq(0)));
        session.handle_frame(now, &resumed()).unwrap();
        tries += 1;
    }
    tries
}

#[test]
fn a_server_that_greets_and_fails_is_left_in_peace() {
    let failing = tries_in_half_a_minute(Duration::from_millis(1));
    assert!((5..=8).contains(&failing), "waits double as if there were no answer: {failing} tries");
    // One that is cut now and then is there again at once.
    assert!((5..=6).contains(&tries_in_half_a_minute(GOOD_CONNECTION)));
    // A person who changes a setting does not wait either, nor is that held against the server.
    let (mut session, _) = welcomed(ClientConfig::default());
    for k in 1..9 {
        session.reconfigure(ClientConfig::default());
        session.handle_loss(at(1000 * k));
        assert!(matches!(session.connectivity(), Connectivity::Reconnecting { attempt: 1, .. }));
    }
}

#[test]
fn what_waits_in_the_inbox_has_arrived() {
    let (mut session, mut server) = welcomed(ClientConfig { apply_on_arrival: false, ..ClientConfig::default() });
    for _ in 0..5 {
        session.handle_frame(at(20), &server.batch(ViewSeq(1), 5)).unwrap();
    }
    session.apply_ready(at(21), 1).unwrap();
    session.handle_loss(at(30));
    session.apply_ready(at(31), 1).unwrap();
    assert_eq!(claim(&mut session, at(1000)).1, Some(BatchSeq(5)));
    session.handle_frame(at(1001), &resumed()).unwrap();
    session.handle_frame(at(1002), &server.batch(ViewSeq(1), 5)).unwrap();
    session.apply_ready(at(1003), u32::MAX).unwrap();
    assert_equal(&session, &server);
}

#[test]
fn a_client_that_waits_for_a_restart_claims_nothing() {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    session.handle_frame(at(20), &server.batch(ViewSeq(1), 5)).unwrap();
    let mut bad = server.batch_message(ViewSeq(1), false, 5);
    bad.digest ^= 1;
    session.handle_frame(at(21), &encode_server(&ServerMessage::Batch(bad))).unwrap();
    session.handle_loss(at(30));
    assert_eq!(claim(&mut session, at(1000)).1, None);
    session.handle_frame(at(1001), &resumed()).unwrap();
    session.handle_frame(at(1002), &server.restart()).unwrap();
    session.handle_frame(at(1003), &server.batch(ViewSeq(1), 5)).unwrap();
    assert_equal(&session, &server);
    assert_eq!(session.stats().resets, 1);
}

#[test]
fn a_client_that_has_nothing_says_hello() {
    let mut session = ClientSession::new(ClientConfig::default());
    session.set_view(at(0), view(0.0)).unwrap();
    sent(&mut session, at(0));
    session.handle_loss(at(5));
    assert!(matches!(sent(&mut session, at(1000))[..], [ClientMessage::Hello(_), ClientMessage::View { .. }]));
    assert!(matches!(session.handle_frame(at(1001), &resumed()), Err(ClientError::OutOfTurn("a resumption"))));
    assert_eq!(session.stats().connections_lost, 0, "there was none yet");
    // Nor may a server resume what was not asked for, or welcome twice.
    let (mut session, server) = welcomed(ClientConfig::default());
    assert!(session.handle_frame(at(11), &resumed()).is_err());
    assert!(session.handle_frame(at(11), &server.welcome()).is_err());
}

#[test]
fn the_old_picture_stays_until_the_new_one_is_as_good() {
    let (mut session, mut server) = welcomed(ClientConfig::default());
    for _ in 0..5 {
        session.handle_frame(at(20), &server.batch(ViewSeq(1), 50)).unwrap();
    }
    session.replica_mut().unwrap().track_dirty();
    session.replica_mut().unwrap().dirty_mut().unwrap().clear();
    let (digest, triangles) = (server.replica().digest(), server.replica().triangle_count());
    let lose = |session: &mut ClientSession, ms| {
        session.handle_loss(at(ms));
        sent(session, at(ms + 500));
    };
    lose(&mut session, 30);
    // The server was started anew.
    let mut server = FakeServer::new();
    session.handle_frame(at(600), &server.welcome()).unwrap();
    assert_eq!(session.connectivity(), Connectivity::Restarting);
    while server.replica().triangle_count() + 8 < triangles {
        session.handle_frame(at(601), &server.batch(ViewSeq(1), 4)).unwrap();
        assert!(session.is_restarting());
        assert_eq!((session.replica().unwrap().digest(), session.generation()), (digest, 1));
    }
    session.handle_frame(at(602), &server.batch(ViewSeq(1), 4)).unwrap();
    assert_equal(&session, &server);
    assert_eq!((session.generation(), session.connectivity()), (2, Connectivity::Connected));
    let dirty = session.replica_mut().unwrap().dirty_mut().expect("tracking goes on");
    assert!(!dirty.vertex_ranges(0).is_empty(), "all of it is new to whoever holds a copy");

    // What the view asks for is good enough, however little it is.
    lose(&mut session, 1000);
    let mut server = FakeServer::new();
    session.handle_frame(at(1600), &server.welcome()).unwrap();
    session.handle_frame(at(1601), &server.batch(ViewSeq(1), 4)).unwrap();
    assert!(session.is_restarting());
    session.handle_frame(at(1602), &server.settled(ViewSeq(1))).unwrap();
    assert!(!session.is_restarting());
    assert_equal(&session, &server);

    // Another model takes its place at once.
    lose(&mut session, 2000);
    let server = FakeServer::new();
    let ServerMessage::Welcome { mut model, cache_entries, token, base } =
        lodestream_protocol::wire::decode_server(&server.welcome()).unwrap()
    else {
        panic!("a welcome");
    };
    model.hash = ModelHash(77);
    let welcome = encode_server(&ServerMessage::Welcome { model, cache_entries, token, base });
    session.handle_frame(at(2600), &welcome).unwrap();
    assert_equal(&session, &server);
    assert_eq!(session.model().unwrap().hash, ModelHash(77));
}
