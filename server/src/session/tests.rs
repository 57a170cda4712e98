//! Sessions without a client: what they do where pages are missing or damaged.

use lodestream_protocol::message::Resume;
use lodestream_protocol::view::UNLIMITED_TRIANGLES;

use super::*;
use crate::pack::testing::{DagOptions, random_dag};
use crate::pack::{Metadata, write_to_vec};

fn pack() -> Vec<u8> {
    let (dag, complete) = random_dag(&DagOptions { splits: 3000, ..DagOptions::default() });
    write_to_vec(&dag, &complete, &Metadata::default()).unwrap()
}

/// A session that was asked for the complete model.
fn looking(bytes: Vec<u8>) -> Session {
    let model = Arc::new(PackedModel::from_vec(bytes).unwrap());
    let mut session = Session::reading_ahead(model, SessionConfig::default());
    let (hello, view) = first_words();
    for message in [ClientMessage::Hello(hello), ClientMessage::View { seq: ViewSeq(1), view }] {
        session.handle_frame(Timestamp::default(), &wire::encode_client(&message)).unwrap();
    }
    session
}

/// Takes and acknowledges all frames that the session gives now.
fn drain(session: &mut Session) -> usize {
    let mut bytes = 0;
    while let Some(frame) = session.poll_transmit(Timestamp::default()).unwrap() {
        bytes += frame.len();
        if let ServerMessage::Batch(batch) = wire::decode_server(&frame).unwrap() {
            let ack = wire::encode_client(&ClientMessage::Ack { seq: BatchSeq(u32::from(batch.seq)) });
            session.handle_frame(Timestamp::default(), &ack).unwrap();
        }
    }
    bytes
}

#[test]
fn a_session_waits_for_pages_without_a_timer_and_wants_each_list_once() {
    let mut session = looking(pack());
    assert!(drain(&mut session) > 0, "the welcome needs no page");
    let wanted = session.poll_wanted().expect("nothing was read yet");
    assert!(!wanted.pages.is_empty() && session.poll_wanted().is_none());
    assert_eq!(session.model.ready_pages(), 0);
    assert_eq!(session.poll_timeout(), None, "no time makes a page arrive");
    session.handle_pages().unwrap();
    assert_eq!(drain(&mut session), 0, "nothing has arrived");
    wanted.model.read_page(wanted.pages[0]).unwrap();
    session.handle_pages().unwrap();
    assert!(drain(&mut session) > 0 || session.poll_wanted().is_some_and(|next| next.pages != wanted.pages));
}

#[test]
fn what_asks_for_all_is_what_a_walk_finds() {
    let model = PackedModel::from_vec(pack()).unwrap();
    let info = model.info();
    let limits = [u32::try_from(info.triangles).unwrap(), info.smallest_limit + 100, UNLIMITED_TRIANGLES];
    let is_for_all = |access, view: &View| select::asks_for_all(&model, access, view);
    let view = first_words().1;
    assert!(!is_for_all(PageAccess::ReadAhead, &view), "pages are missing");
    for triangle_limit in limits {
        let view = View { triangle_limit, ..view.clone() };
        let scorer = score::Scorer::new(&view, info);
        let found = select::select(&model, &scorer, triangle_limit, PageAccess::Blocking).unwrap();
        let is_all = found.set.len() == model.op_count() as usize && !found.is_limited;
        assert_eq!(is_for_all(PageAccess::Blocking, &view), is_all, "{triangle_limit}");
        if is_all {
            assert_eq!((found.lambda, found.error), (scorer.threshold(), 0.0));
        }
    }
    assert!(model.page_count() > 1 && !is_for_all(PageAccess::Blocking, &View { complete: false, ..view.clone() }));
    (0..model.page_count()).for_each(|page| model.read_page(PageId::Ops(page)).unwrap());
    (0..model.spawn_count().div_ceil(256)).for_each(|page| model.read_page(PageId::Patches(page)).unwrap());
    assert!(is_for_all(PageAccess::ReadAhead, &view), "all pages are there");
}

#[test]
fn a_bad_page_ends_the_sessions_that_want_it_and_quarantines_the_model() {
    let mut bytes = pack();
    let at = bytes.len() * 2 / 3;
    bytes[at] ^= 1;
    let mut session = looking(bytes);
    let end = loop {
        drain(&mut session);
        let wanted = session.poll_wanted().expect("the damaged page is among the wanted sooner or later");
        wanted.pages.iter().for_each(|&page| _ = wanted.model.read_page(page));
        if let Err(end) = session.handle_pages() {
            break end;
        }
    };
    assert_eq!(end.code(), CloseCode::ModelDamaged);
    assert!(session.model.damage().is_some());
}

fn first_words() -> (Hello, View) {
    let hello =
        Hello { version: PROTOCOL_VERSION, cache_entries: None, byte_rate: None, triangle_limit: UNLIMITED_TRIANGLES };
    let mut view = View::perspective(glam::DVec3::Z, glam::DVec3::ZERO, 1.0);
    view.complete = true;
    view.triangle_limit = UNLIMITED_TRIANGLES;
    (hello, view)
}

fn say(session: &mut Session, message: &ClientMessage) -> Result<(), SessionError> {
    session.handle_frame(Timestamp::default(), &wire::encode_client(message))
}

fn hear(session: &mut Session) -> Vec<ServerMessage> {
    let frames = std::iter::from_fn(|| session.poll_transmit(Timestamp::default()).unwrap());
    frames.map(|frame| wire::decode_server(&frame).unwrap()).collect()
}

fn resume(received: Option<u32>) -> ClientMessage {
    ClientMessage::Resume(Resume { hello: first_words().0, token: Token([1; 16]), received: received.map(BatchSeq) })
}

/// A session that has sent as many batches as its window holds, of which one is acknowledged, and those batches.
fn cut_session() -> (Session, Vec<ServerMessage>) {
    let model = Arc::new(PackedModel::from_vec(pack()).unwrap());
    let mut session = Session::new(model, SessionConfig::default());
    assert!(!session.park(), "nobody was here");
    session.offer(Token([1; 16]));
    let (hello, view) = first_words();
    say(&mut session, &ClientMessage::Hello(hello)).unwrap();
    say(&mut session, &ClientMessage::View { seq: ViewSeq(1), view }).unwrap();
    let mut sent = hear(&mut session);
    assert!(matches!(sent.remove(0), ServerMessage::Welcome { token: Some(token), .. } if token == Token([1; 16])));
    assert!(sent.len() >= 3, "{}", sent.len());
    say(&mut session, &ClientMessage::Ack { seq: BatchSeq(1) }).unwrap();
    sent.extend(hear(&mut session));
    assert!(session.park());
    assert!(session.mirror().is_none() && session.poll_timeout().is_none() && hear(&mut session).is_empty());
    session.offer(Token([2; 16]));
    (session, sent)
}

#[test]
fn a_session_resumes_after_any_batch_that_may_be_the_last_to_arrive() {
    let count = cut_session().1.len() as u32;
    for received in 1..=count {
        let (mut session, sent) = cut_session();
        say(&mut session, &resume(Some(received))).unwrap();
        let mut heard = hear(&mut session);
        assert_eq!(heard.remove(0), ServerMessage::Resumed { token: Token([2; 16]) });
        let again = &sent[received as usize..];
        assert_eq!(&heard[..again.len()], again, "those after {received} as they were");
        assert_eq!(session.stats().resumes, 1);
        let bytes: usize = again.iter().map(|message| wire::encode_server(message).len()).sum();
        assert_eq!(session.stats().bytes_sent_again, bytes as u64);
        // The view in force may be said once more, and only now.
        let (_, view) = first_words();
        let repeated = ClientMessage::View { seq: ViewSeq(1), view };
        say(&mut session, &repeated).unwrap();
        assert!(say(&mut session, &repeated).is_err());
    }
}

#[test]
fn a_claim_that_cannot_be_begins_the_session_anew() {
    let count = cut_session().1.len() as u32;
    for received in [0, count + 1, 1 << 20, u32::MAX] {
        let (mut session, _) = cut_session();
        say(&mut session, &resume(Some(received))).unwrap();
        let heard = hear(&mut session);
        assert!(matches!(heard[..], [ServerMessage::Welcome { token: Some(token), .. }] if token == Token([2; 16])));
        let (_, view) = first_words();
        say(&mut session, &ClientMessage::View { seq: ViewSeq(9), view }).unwrap();
        assert!(matches!(&hear(&mut session)[0], ServerMessage::Batch(batch) if batch.seq == 1));
        assert_eq!(session.stats().resumes, 0);
    }
    let (mut session, _) = cut_session();
    let mut old = first_words().0;
    old.version = 3;
    let claim = Resume { hello: old, token: Token([1; 16]), received: Some(BatchSeq(1)) };
    assert_eq!(say(&mut session, &ClientMessage::Resume(claim)).unwrap_err().code(), CloseCode::Version);
}

#[test]
fn a_client_that_waits_for_a_restart_gets_one() {
    let (mut session, _) = cut_session();
    say(&mut session, &resume(None)).unwrap();
    let heard = hear(&mut session);
    assert_eq!(heard[..2], [ServerMessage::Resumed { token: Token([2; 16]) }, ServerMessage::Restart]);
    assert!(matches!(&heard[2], ServerMessage::Batch(batch) if batch.seq == 1 && batch.limit.is_some()));
}

#[test]
fn a_connection_resumes_first_or_not_at_all() {
    let (mut session, _) = cut_session();
    say(&mut session, &resume(Some(1))).unwrap();
    for message in [resume(Some(1)), ClientMessage::Hello(first_words().0)] {
        assert_eq!(say(&mut session, &message).unwrap_err().code(), CloseCode::Malformed);
    }
    let model = Arc::new(PackedModel::from_vec(pack()).unwrap());
    let mut session = Session::new(model, SessionConfig::default());
    session.offer(Token([3; 16]));
    say(&mut session, &resume(Some(1))).unwrap();
    assert!(matches!(hear(&mut session)[..], [ServerMessage::Welcome { .. }]), "a session that knows nothing of it");
}

#[test]
fn what_is_kept_is_bounded_by_the_window_and_counted() {
    let model = Arc::new(PackedModel::from_vec(pack()).unwrap());
    let mut plain = Session::new(model.clone(), SessionConfig::default());
    let (hello, view) = first_words();
    say(&mut plain, &ClientMessage::Hello(hello)).unwrap();
    say(&mut plain, &ClientMessage::View { seq: ViewSeq(1), view }).unwrap();
    hear(&mut plain);
    assert_eq!(plain.running.as_ref().unwrap().unacknowledged.heap_bytes(), 0, "without a token nothing is kept");
    assert!(!plain.park());
    let (mut session, sent) = cut_session();
    let held = session.running.as_ref().unwrap().unacknowledged.heap_bytes();
    assert!(held > 4096 && held < 40_000, "{held} bytes where the window is 16 KB");
    assert!(session.stats().heap_bytes >= held as u64);
    say(&mut session, &resume(Some(sent.len() as u32))).unwrap();
    assert!(session.running.as_ref().unwrap().unacknowledged.heap_bytes() < 1000);
}
