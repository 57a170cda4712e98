//! The decoder of ops as a WebAssembly module without imports.
//!
//! A host calls [`push`] for each byte of the base and then [`base`], likewise [`push`] and [`batch`] for each batch; or [`push`] and
//! [`frame`] for each frame that a server sent. It needs no view of the module's memory. Whatever goes wrong traps.

// Exporting a name is the only thing here that asks for it.
#![allow(unsafe_code)]

use std::cell::RefCell;
use std::mem::take;
use std::num::NonZeroU16;

use lodestream_protocol::message::ServerMessage;
use lodestream_protocol::op::{OpState, decode_base, decode_batch};
use lodestream_protocol::wire::decode_server;

#[derive(Default)]
struct Module {
    bytes: Vec<u8>,
    state: Option<OpState>,
    /// That of the batches, until one says otherwise.
    limit: u32,
}

thread_local! {
    static MODULE: RefCell<Module> = RefCell::default();
}

fn with<T>(run: impl FnOnce(&mut Module) -> T) -> T {
    MODULE.with_borrow_mut(run)
}

/// Adds a byte to what the next call decodes.
#[unsafe(no_mangle)]
pub extern "C" fn push(byte: u32) {
    with(|module| module.bytes.push(byte as u8));
}

/// Begins a session with the base that was pushed, whatever came before. Returns the digest.
#[unsafe(no_mangle)]
pub extern "C" fn base(
    lattice_bits: u32,
    has_colors: u32,
    has_moves: u32,
    visual_step: u32,
    cache_entries: u32,
) -> u64 {
    with(|module| {
        let (bits, has_colors) = (lattice_bits as u8, has_colors != 0);
        let base = decode_base(&take(&mut module.bytes), bits, has_colors).expect("the base decodes");
        let state = OpState::new(&base, bits, has_colors, has_moves != 0, cache_entries);
        let state = state.expect("the base is a manifold").with_step(NonZeroU16::new(visual_step as u16));
        module.state.insert(state).replica().digest()
    })
}

/// Applies the batch that was pushed. Returns the digest.
#[unsafe(no_mangle)]
pub extern "C" fn batch(limit: u32) -> u64 {
    with(|module| {
        let state = module.state.as_mut().expect("a base comes first");
        decode_batch(&take(&mut module.bytes), state, limit).expect("the batch decodes");
        state.replica().digest()
    })
}

/// Does what the frame that was pushed says, and checks the digest that a batch carries. Returns how many vertices were split.
#[unsafe(no_mangle)]
pub extern "C" fn frame() -> u32 {
    with(|module| match decode_server(&take(&mut module.bytes)).expect("a frame of a server") {
        ServerMessage::Welcome { model, cache_entries, base, .. } => {
            let (bits, has_colors) = (model.lattice.bits, model.has_colors);
            let base = decode_base(&base, bits, has_colors).expect("the base decodes");
            let state = OpState::new(&base, bits, has_colors, model.has_moves, cache_entries);
            module.state = Some(state.expect("the base is a manifold").with_step(model.visual_step));
            0
        }
        ServerMessage::Batch(batch) => {
            module.limit = batch.limit.unwrap_or(module.limit);
            let state = module.state.as_mut().expect("a welcome comes first");
            let counts = decode_batch(&batch.ops, state, module.limit).expect("the batch decodes");
            assert_eq!(state.replica().digest() as u16, batch.digest, "the mesh is not the server's");
            counts.splits
        }
        ServerMessage::Settled(_) => 0,
        ServerMessage::Restart | ServerMessage::Resumed { .. } => panic!("a session that goes one way"),
    })
}
