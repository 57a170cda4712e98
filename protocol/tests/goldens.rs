//! Golden frames of protocol version 6: the bytes of fixed messages and of a fixed session, as hexadecimal files. They hold
//! `PROTOCOL.md` and the code together and are never rewritten; a new version adds a folder.

use std::path::PathBuf;

use glam::DVec3;
use lodestream_protocol::ids::{BatchSeq, ModelHash, Token, VertexSlot, ViewSeq};
use lodestream_protocol::mesh::{Cut, NewVertex, Patch};
use lodestream_protocol::message::{Batch, ClientMessage, Hello, ModelInfo, Outcome, Resume, ServerMessage, Settled};
use lodestream_protocol::op::{BatchEncoder, OpState, canonical_order, decode_base, decode_batch, encode_base};
use lodestream_protocol::quant::Lattice;
use lodestream_protocol::view::{Projection, View};
use lodestream_protocol::wire::{decode_client, decode_server, encode_client, encode_server};

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/golden/v6")
}

fn hex(bytes: &[u8]) -> String {
    let digits: Vec<String> = bytes.iter().map(|b| format!("{b:02x}")).collect();
    digits.chunks(32).map(|line| line.concat() + "\n").collect()
}

fn golden(name: &str) -> Vec<u8> {
    let text = std::fs::read_to_string(folder().join(name)).unwrap_or_else(|e| panic!("golden {name}: {e}"));
    let digits: Vec<u8> = text.bytes().filter(u8::is_ascii_hexdigit).collect();
    let pair = |p: &[u8]| u8::from_str_radix(std::str::from_utf8(p).unwrap(), 16).unwrap();
    digits.chunks(2).map(pair).collect()
}

/// A pyramid over a square: five vertices, six faces, closed.
fn base() -> Patch {
    Patch {
        positions: vec![[0, 0, 0], [1000, 0, 0], [1000, 0, 1000], [0, 0, 1000], [500, 900, 500]],
        colors: vec![[10, 20, 30], [200, 20, 30], [10, 200, 30], [10, 20, 230], [255, 255, 255]],
        faces: vec![[0, 1, 2], [0, 2, 3], [1, 0, 4], [2, 1, 4], [3, 2, 4], [0, 3, 4]],
    }
}

fn state() -> OpState {
    OpState::new(&base(), 10, true, false, 8).unwrap()
}

/// Three batches: splits in two rounds and a spawn; collapses and a despawn; a split from the cache.
fn batches() -> Vec<Vec<u8>> {
    let mut state = state();
    let vertex = |x: i32| NewVertex { position: [x, 500, 400], color: [x as u8, 90, 80], ..NewVertex::default() };
    let triangle = Patch {
        positions: vec![[1, 2, 3], [40, 50, 60], [7, 80, 9]],
        colors: vec![[1, 1, 1], [2, 2, 2], [3, 3, 3]],
        faces: vec![[0, 1, 2]],
    };
    let mut out = Vec::new();

    let mut encoder = BatchEncoder::new(&mut state, false);
    assert!(!encoder.collapse_round(&[]).unwrap());
    encoder.spawns(&[(3, &triangle)], 100).unwrap();
    encoder.split_round(&[0, 4]).unwrap();
    encoder.split(0, 100, |_, _| Some((Cut::Both { right: 0, left: 2 }, vertex(100)))).unwrap();
    encoder.split(4, 100, |_, _| Some((Cut::Both { right: 1, left: 3 }, vertex(450)))).unwrap();
    assert!(encoder.end_split_round());
    let second: Vec<u32> = encoder.candidates().take(1).collect();
    encoder.split_round(&second).unwrap();
    encoder.split(second[0], 100, |_, _| Some((Cut::Both { right: 0, left: 1 }, vertex(60)))).unwrap();
    assert!(encoder.end_split_round());
    encoder.split_round(&[]).unwrap();
    out.push(encoder.finish().0);

    let mut encoder = BatchEncoder::new(&mut state, false);
    let free: Vec<u32> = encoder.replica().collapsible().iter().collect();
    assert!(free.iter().any(|&slot| encoder.replica().is_spawn(VertexSlot(slot))));
    encoder.collapse_round(&free).unwrap();
    if encoder.candidates().next().is_some() {
        encoder.collapse_round(&[]).unwrap();
    }
    encoder.spawns(&[], 100).unwrap();
    encoder.split_round(&[]).unwrap();
    out.push(encoder.finish().0);

    let cached = (0..state.replica().slot_end()).find(|&v| state.cache().top(VertexSlot(v)).is_some()).unwrap();
    let top = state.cache().top(VertexSlot(cached)).unwrap();
    let mut encoder = BatchEncoder::new(&mut state, true);
    encoder.collapse_round(&[]).unwrap();
    encoder.spawns(&[], 100).unwrap();
    encoder.split_round(&[cached]).unwrap();
    encoder.split(cached, 100, |_, _| Some((Cut::Both { right: 0, left: 1 }, top.vertex))).unwrap();
    if encoder.end_split_round() {
        encoder.split_round(&[]).unwrap();
    }
    out.push(encoder.finish().0);
    out
}

fn token(first: u8) -> Token {
    Token(std::array::from_fn(|i| first + i as u8))
}

fn client_messages() -> Vec<(&'static str, ClientMessage)> {
    let mut view = View::perspective(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, 0.75);
    // Fixed numbers instead of trigonometry.
    view.orientation = [0.0, 0.0, 0.0, 1.0];
    let mut section = view.clone();
    section.projection = Projection::Orthographic { height: 2.5 };
    section.clip_planes = vec![[1.0, 0.0, 0.0, -0.5]];
    section.complete = true;
    let hello = Hello { version: 6, triangle_limit: 1_000_000, cache_entries: Some(300), byte_rate: None };
    let resume = Resume { hello, token: token(0xa0), received: Some(BatchSeq(250)) };
    vec![
        ("hello.hex", ClientMessage::Hello(hello)),
        ("view.hex", ClientMessage::View { seq: ViewSeq(1), view }),
        ("view_section.hex", ClientMessage::View { seq: ViewSeq(70_000), view: section }),
        ("ack.hex", ClientMessage::Ack { seq: BatchSeq(250) }),
        ("reset.hex", ClientMessage::Reset { seq: BatchSeq(251) }),
        ("resume.hex", ClientMessage::Resume(resume)),
        ("resume_anew.hex", ClientMessage::Resume(Resume { received: None, ..resume })),
    ]
}

fn server_messages() -> Vec<(&'static str, ServerMessage)> {
    let model = ModelInfo {
        hash: ModelHash(0x0123_4567_89ab_cdef),
        title: "pyramid".into(),
        lattice: Lattice { origin: [0.0, -1.0, 0.5], step: 0.125, bits: 10 },
        box_min: [0, 0, 0],
        box_max: [1000, 900, 1000],
        has_colors: true,
        has_moves: false,
        visual_step: None,
        is_open: false,
        triangles: 12,
        vertices: 8,
        smallest_limit: 6,
        crease_angle_deg: 45.0,
    };
    let encoded = encode_base(&base(), 10, true);
    let mut messages = vec![
        (
            "welcome.hex",
            ServerMessage::Welcome {
                model: model.clone(),
                cache_entries: 8,
                token: Some(token(0xa0)),
                base: encoded.clone(),
            },
        ),
        ("welcome_no_token.hex", ServerMessage::Welcome { model, cache_entries: 8, token: None, base: encoded }),
        (
            "settled.hex",
            ServerMessage::Settled(Settled {
                view: ViewSeq(1),
                seq: BatchSeq(3),
                outcome: Outcome { error_px: 0.5, limited: true },
            }),
        ),
        ("restart.hex", ServerMessage::Restart),
        ("resumed.hex", ServerMessage::Resumed { token: token(0xb0) }),
    ];
    let mut state = state();
    for ((seq, ops), name) in (1..).zip(batches()).zip(["batch_1.hex", "batch_2.hex", "batch_3.hex"]) {
        decode_batch(&ops, &mut state, 100).unwrap();
        let digest = state.replica().digest() as u16;
        // The first says what holds, the last that the view is settled.
        let first = seq == 1;
        let (limit, lambda_px) = (first.then_some(100), first.then_some(1.0));
        let outcome = (seq == 3).then_some(Outcome { error_px: 0.25, limited: false });
        let batch = Batch { seq, view: ViewSeq(1).low(), limit, lambda_px, digest, outcome, ops };
        messages.push((name, ServerMessage::Batch(batch)));
    }
    messages
}

#[test]
fn every_client_frame_is_as_it_was() {
    for (name, message) in client_messages() {
        let bytes = golden(name);
        assert_eq!(decode_client(&bytes).unwrap(), message, "{name}");
        assert_eq!(hex(&encode_client(&message)), hex(&bytes), "{name}");
    }
}

#[test]
fn every_server_frame_is_as_it_was() {
    for (name, message) in server_messages() {
        let bytes = golden(name);
        assert_eq!(decode_server(&bytes).unwrap(), message, "{name}");
        assert_eq!(hex(&encode_server(&message)), hex(&bytes), "{name}");
    }
}

/// The stored session decodes by itself: base, three batches, digests.
#[test]
fn the_session_still_decodes() {
    let ServerMessage::Welcome { base, model, cache_entries, .. } = decode_server(&golden("welcome.hex")).unwrap()
    else {
        panic!("the welcome is no welcome");
    };
    let base = decode_base(&base, model.lattice.bits, model.has_colors).unwrap();
    let mut state = OpState::new(&base, model.lattice.bits, model.has_colors, model.has_moves, cache_entries).unwrap();
    let (mut triangles, mut limit) = (Vec::new(), 0);
    for name in ["batch_1.hex", "batch_2.hex", "batch_3.hex"] {
        let ServerMessage::Batch(batch) = decode_server(&golden(name)).unwrap() else { panic!("{name} is no batch") };
        limit = batch.limit.unwrap_or(limit);
        decode_batch(&batch.ops, &mut state, limit).unwrap();
        assert_eq!(state.replica().digest() as u16, batch.digest, "{name}");
        triangles.push(state.replica().triangle_count());
    }
    // The last split of the first batch refers to both before it, so the second batch may undo it and the spawn only.
    assert_eq!(triangles, [13, 10, 12]);
}

/// The base as it is walked: its order is that of the walk, and so are the bytes.
#[test]
fn a_walked_base_is_as_it_was() {
    let bytes = golden("base.hex");
    let order = canonical_order(&base()).unwrap();
    // From the corner with the smallest coordinates, in the first face there; then always across the newest edge.
    assert_eq!(order.vertices, [0, 1, 2, 3, 4]);
    let walked = order.apply(&base());
    assert_eq!(decode_base(&bytes, 10, true).unwrap(), walked);
    assert_eq!(hex(&encode_base(&walked, 10, true)), hex(&bytes));
}

/// What a server must still understand of clients of other versions, to tell them the version.
#[test]
fn hellos_of_other_versions_decode() {
    for version in [1, 3, 4] {
        let ClientMessage::Hello(hello) = decode_client(&golden(&format!("../v{version}/hello.hex"))).unwrap() else {
            panic!("the hello is none")
        };
        assert_eq!(hello.version, version);
    }
}

/// Writes the files of a new version. Refuses to touch files that exist.
#[test]
#[ignore = "only for a new version of the protocol"]
fn write_goldens() {
    let client = client_messages().into_iter().map(|(name, message)| (name, encode_client(&message)));
    let server = server_messages().into_iter().map(|(name, message)| (name, encode_server(&message)));
    let walked = canonical_order(&base()).unwrap().apply(&base());
    let base = std::iter::once(("base.hex", encode_base(&walked, 10, true)));
    for (name, bytes) in client.chain(server).chain(base) {
        let path = folder().join(name);
        assert!(!path.exists(), "{name} exists: goldens are never rewritten");
        std::fs::write(path, hex(&bytes)).unwrap();
    }
}
