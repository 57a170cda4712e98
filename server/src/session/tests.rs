//! Sessions without a client: what they do where pages are missing or damaged.

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
    let hello =
        Hello { version: PROTOCOL_VERSION, cache_entries: None, byte_rate: None, triangle_limit: UNLIMITED_TRIANGLES };
    let mut view = View::perspective(glam::DVec3::Z, glam::DVec3::ZERO, 1.0);
    view.complete = true;
    view.triangle_limit = UNLIMITED_TRIANGLES;
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
