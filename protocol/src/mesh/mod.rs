//! The current mesh as both ends hold it.
//!
//! [`Replica`] is connectivity, positions and colours plus what an op needs to be undone; [`DirtySlots`] says what changed
//! for whoever copies the mesh elsewhere (GPU buffers).

mod bits;
mod digest;
mod dirty;
mod fan;
mod growth;
mod patch;
mod references;
mod replica;

pub use bits::SlotSet;
pub use dirty::{Birth, DirtySlots};
pub use fan::{Cut, Fan};
pub use growth::reserve_a_sixteenth;
pub use patch::{Patch, PatchError, twins_of};
pub use replica::{ApplyError, NewVertex, Replica, SplitUndo, TOUCHED_AT_ONCE};
