//! Mutation fuzzing of everything that takes bytes from outside. A target takes a generator and runs one case; it must
//! neither panic nor hang nor allocate without bound, whatever the bytes.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use fastrand::Rng;
use glam::DVec3;
use lodestream_client::core::{ClientConfig, ClientSession};
use lodestream_protocol::ids::{BatchSeq, Token};
use lodestream_protocol::mesh::{Patch, Replica};
use lodestream_protocol::message::{ClientMessage, Hello, PROTOCOL_VERSION, Resume, ServerMessage};
use lodestream_protocol::op::{canonical_order, decode_base, encode_base};
use lodestream_protocol::testing::base_meshes;
use lodestream_protocol::time::Timestamp;
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_protocol::wire::{self, encode_client, encode_server};
use lodestream_server::ingest::ingest_to_vec;
use lodestream_server::ingest::read::testing::{Seeds, jpeg, png, seeds};
use lodestream_server::ingest::read::{read_gltf, read_mesh_in_memory, read_obj, read_off, read_ply, read_stl};
use lodestream_server::ingest::simplify::BuildOptions;
use lodestream_server::mesh::export::{PlyOptions, write_obj, write_ply, write_stl};
use lodestream_server::pack::{self, Metadata, PackedModel, extract_complete};
use lodestream_server::session::{Session, SessionConfig};

use crate::meshes;
use crate::model::TestModel;
use crate::server_process::TempDir;
use crate::sim::{Pair, PairConfig};

/// Runs one case. A target that reads files says how long the file was: its peak of memory is bounded by that.
pub type Case = Box<dyn Fn(&mut Rng) -> Option<usize>>;

/// Frames that cases have handed to a client or to a server so far.
pub static FRAMES: AtomicU64 = AtomicU64::new(0);

/// A named target.
pub struct Target {
    /// For the command line and for reports.
    pub name: &'static str,
    /// Runs one case.
    pub run: Case,
}

/// Flips, cuts, repeats, inserts: a few changes at random places.
pub fn mutate(rng: &mut Rng, bytes: &mut Vec<u8>) {
    for _ in 0..1 + rng.usize(0..4) {
        let at = rng.usize(0..bytes.len() + 1);
        match rng.u8(0..8) {
            0 => bytes.truncate(at),
            1 => bytes.insert(at, rng.u8(..)),
            2 => {
                let end = (at + rng.usize(0..9)).min(bytes.len());
                bytes.drain(at..end);
            }
            3 => {
                let end = (at + rng.usize(0..17)).min(bytes.len());
                let piece: Vec<u8> = bytes[at..end].to_vec();
                let to = rng.usize(0..bytes.len() + 1);
                bytes.splice(to..to, piece);
            }
            4 if at < bytes.len() => bytes[at] = [0, 1, 0x7f, 0x80, 0xff, 251, 252, 253][rng.usize(0..8)],
            5 if at < bytes.len() => bytes[at] = bytes[at].wrapping_add(1),
            _ if at < bytes.len() => bytes[at] ^= 1 << rng.u8(0..8),
            _ => {}
        }
    }
}

/// Everything that takes bytes from outside.
pub fn targets() -> Vec<Target> {
    let test = TestModel::new(meshes::many_components(20, 7), Some(12));
    let colored = TestModel::new(meshes::colored_sphere(3), Some(12));
    let recorded = [record(&test.model), record(&colored.model)];
    let [down, up] = [0, 1].map(|end| {
        let frames: Vec<Vec<Vec<u8>>> = recorded.iter().map(|frames| frames[end].clone()).collect();
        Arc::new(frames)
    });
    let models = [test.model.clone(), colored.model.clone()];
    let pack = small_pack();

    let mut targets: Vec<Target> = Vec::new();
    let unbounded = |run: Box<dyn Fn(&mut Rng)>| -> Case {
        Box::new(move |rng| {
            run(rng);
            None
        })
    };
    let mut add = |name, run| targets.push(Target { name, run: unbounded(run) });
    let frames = down.clone();
    add("client", Box::new(move |rng| client_case(rng, &frames)));
    let frames = up.clone();
    add("server", Box::new(move |rng| server_case(rng, &models, &frames)));
    add(
        "wire",
        Box::new(move |rng| {
            let sessions = if rng.bool() { &down } else { &up };
            let frames = &sessions[rng.usize(0..sessions.len())];
            let mut frame = frames[rng.usize(0..frames.len())].clone();
            mutate(rng, &mut frame);
            let _ = (wire::decode_client(&frame), wire::decode_server(&frame));
        }),
    );
    let bases = bases(&colored.model);
    add("base", Box::new(move |rng| base_case(rng, &bases)));
    add("pack", Box::new(move |rng| pack_case(rng, &pack)));
    targets.extend(readers());
    targets
}

/// The readers of mesh files, without what is slow to prepare.
pub fn readers() -> Vec<Target> {
    let mut targets = Vec::new();
    for Seeds { format, mut files } in seeds() {
        let read = match format {
            "ply" => read_ply,
            "obj" => read_obj,
            "stl" => read_stl,
            "off" => read_off,
            _ => read_gltf,
        };
        let mesh = meshes::colored_sphere(1);
        let mut larger = Vec::new();
        match format {
            "ply" => write_ply(&mesh, &PlyOptions::default(), &mut larger).expect("writing to memory"),
            "obj" => write_obj(&mesh, &mut larger).expect("writing to memory"),
            "stl" => write_stl(&mesh, &mut larger).expect("writing to memory"),
            _ => larger.clone_from(&files[0]),
        }
        files.push(larger);
        let run = move |rng: &mut Rng| {
            let file = rng.usize(0..files.len());
            let bytes = mutated(rng, &files[file]);
            let _ = read(&bytes);
            Some(bytes.len())
        };
        targets.push(Target { name: format, run: Box::new(run) });
    }
    let folder = TempDir::new();
    targets.push(Target { name: "obj-mtl", run: Box::new(move |rng| Some(textured_case(rng, &folder))) });
    targets
}

/// An OBJ with its library and its textures, one of which is damaged.
fn textured_case(rng: &mut Rng, folder: &TempDir) -> usize {
    let library = b"newmtl a\nKd 1 0.5 0\nmap_Kd -s 2 2 -clamp on t.png\nnewmtl b\nmap_Kd t.jpg\nnewmtl c\nKd 0 0 1\n";
    let mesh = b"mtllib t.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nvt 0 0\nvt 0.5 0.25\nvt 1 1\nusemtl a\n\
                 f 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/-1\nusemtl c\nf 2 3 4\n";
    let texture = png(3, 2, &[[1, 2, 3], [40, 50, 60], [255; 3], [0; 3], [9, 8, 7], [200, 100, 50]]);
    let mut files = [("t.obj", mesh.to_vec()), ("t.mtl", library.to_vec()), ("t.png", texture), ("t.jpg", jpeg())];
    let damaged = rng.usize(0..files.len());
    mutate(rng, &mut files[damaged].1);
    for (name, bytes) in &files {
        std::fs::write(folder.join(name), bytes).expect("the folder can be written to");
    }
    let _ = read_mesh_in_memory(&folder.join("t.obj"));
    files.iter().map(|(_, bytes)| bytes.len()).sum()
}

fn mutated(rng: &mut Rng, bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    mutate(rng, &mut bytes);
    bytes
}

/// The frames of a short session, server to client and back.
fn record(model: &Arc<PackedModel>) -> [Vec<Vec<u8>>; 2] {
    let mut pair = Pair::new(model.clone(), PairConfig::default());
    pair.keep_frames();
    let corner = |q| DVec3::from_array(model.info().lattice.position(q));
    let (min, max) = (corner(model.info().box_min), corner(model.info().box_max));
    for step in 0..4 {
        let angle = f64::from(step);
        let eye = (min + max) / 2.0 + DVec3::new(angle.sin(), 0.3, angle.cos()) * (max - min).length();
        let mut view = View::perspective(eye, (min + max) / 2.0, 0.8);
        view.near = (max - min).length() * 1e-3;
        view.tolerance_px = 0.5;
        view.triangle_limit = if step == 2 { 400 } else { UNLIMITED_TRIANGLES };
        pair.look(view);
        pair.settle();
    }
    pair.kept_frames()
}

/// A client that is sent a real session up to some frame, then bad ones.
fn client_case(rng: &mut Rng, sessions: &[Vec<Vec<u8>>]) {
    let frames = &sessions[rng.usize(0..sessions.len())];
    let mut client = ClientSession::new(ClientConfig::default());
    let good = rng.usize(0..frames.len().min(8));
    let mut now = Timestamp::default();
    let picks = [0; 3].map(|_: usize| rng.usize(0..frames.len()));
    let bad = picks.map(|i| mutated(rng, &frames[i]));
    for frame in frames[..good].iter().chain(&bad).chain(&frames[good..]) {
        now = now + std::time::Duration::from_millis(5);
        if rng.u8(0..6) == 0 {
            client.handle_loss(now);
        }
        while client.poll_transmit(now).is_some() {}
        if rng.u8(0..6) == 0 {
            let answer = encode_server(&ServerMessage::Resumed { token: Token([rng.u8(..); 16]) });
            let answer = if rng.bool() { mutated(rng, &answer) } else { answer };
            FRAMES.fetch_add(1, Ordering::Relaxed);
            if client.handle_frame(now, &answer).is_err() {
                break;
            }
        }
        FRAMES.fetch_add(1, Ordering::Relaxed);
        if client.handle_frame(now, frame).is_err() {
            break;
        }
    }
}

/// A server session that hears a real client, then bad frames; it is polled as a driver would, within bounds.
fn server_case(rng: &mut Rng, models: &[Arc<PackedModel>; 2], sessions: &[Vec<Vec<u8>>]) {
    let which = rng.usize(0..2);
    let frames = &sessions[which];
    let mut server = Session::new(models[which].clone(), SessionConfig::default());
    if rng.u8(0..4) > 0 {
        server.offer(Token([1; 16]));
    }
    let mut now = Timestamp::default();
    for frame in frames.iter().take(rng.usize(1..12)) {
        now = now + std::time::Duration::from_millis(5);
        let mut bytes = if rng.u8(0..3) == 0 { mutated(rng, frame) } else { frame.clone() };
        if rng.u8(0..4) == 0 {
            // The connection breaks, and who comes back claims anything.
            if rng.u8(0..4) > 0 {
                server.park();
            }
            bytes = claim(rng);
            if rng.u8(0..3) == 0 {
                bytes = mutated(rng, &bytes);
            }
        }
        FRAMES.fetch_add(1, Ordering::Relaxed);
        if server.handle_frame(now, &bytes).is_err() {
            return;
        }
        for _ in 0..3 {
            match server.poll_transmit(now) {
                Ok(Some(_)) => {}
                Ok(None) => break,
                Err(error) => panic!("a client's frame broke the server's own state: {error}"),
            }
        }
    }
}

/// A wish to go on with a session.
fn claim(rng: &mut Rng) -> Vec<u8> {
    let hello = Hello {
        version: PROTOCOL_VERSION,
        triangle_limit: rng.u32(..),
        cache_entries: rng.bool().then(|| rng.u32(..)),
        byte_rate: rng.bool().then(|| rng.u32(..)),
    };
    let received = [None, Some(rng.u32(0..6)), Some(rng.u32(0..6)), Some(rng.u32(..))][rng.usize(0..4)];
    let token = Token(std::array::from_fn(|_| rng.u8(..)));
    encode_client(&ClientMessage::Resume(Resume { hello, token, received: received.map(BatchSeq) }))
}

/// Patches of every topology and a larger one with colours, coded.
fn bases(model: &PackedModel) -> Vec<Vec<u8>> {
    let larger = extract_complete(model).expect("the pack is whole");
    let quantize = |p: &[f64; 3]| model.info().lattice.quantize(*p);
    let larger = Patch {
        positions: larger.positions.iter().map(quantize).collect(),
        colors: larger.colors.clone().expect("the model has colours"),
        faces: larger.faces.clone(),
    };
    let mut bases = Vec::new();
    for patch in base_meshes().into_iter().map(|(_, patch)| patch).chain([larger]) {
        let walked = canonical_order(&patch).map(|order| order.apply(&patch));
        bases.extend([Some(patch), walked].iter().flatten().map(|patch| encode_base(patch, 12, true)));
    }
    bases
}

fn base_case(rng: &mut Rng, bases: &[Vec<u8>]) {
    let base = rng.usize(0..bases.len());
    let bytes = mutated(rng, &bases[base]);
    let Ok(patch) = decode_base(&bytes, 12, rng.u8(0..4) > 0) else { return };
    if Replica::new(&patch).is_ok() {
        let again = encode_base(&patch, 12, true);
        assert_eq!(decode_base(&again, 12, true).as_ref(), Ok(&patch), "what was decoded can be encoded");
    }
}

fn small_pack() -> Vec<u8> {
    let options = BuildOptions { bits: Some(10), ..BuildOptions::default() };
    let mesh = meshes::many_components(6, 3);
    ingest_to_vec(&mesh, &options, &Metadata::default()).expect("the mesh can be built").0
}

fn pack_case(rng: &mut Rng, bytes: &[u8]) {
    let bytes = mutated(rng, bytes);
    let _ = pack::verify(Arc::new(bytes.clone()));
    let Ok(model) = PackedModel::from_vec(bytes) else { return };
    for _ in 0..20 {
        let op = rng.u32(0..model.op_count().max(1) + 2);
        let _ = model.bounds(op);
        if op >= model.spawn_count() {
            let _ = (model.children(op), model.split(op), model.parents(op));
        } else {
            let _ = (model.spawn_patch(op), model.spawn_first_splits(op));
        }
    }
}
