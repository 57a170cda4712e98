//! The judge: how far a mesh strays from the original, as seen. It knows meshes, packs and what a view asks for; nobody below
//! depends on it, so that it shares no shortcut with what it judges.
//!
//! [`original`] holds the mesh that others are measured against and says what of it a view shows, [`screen_error`] measures,
//! [`calibration`] does so for what random views ([`random_views`]) are sent, [`tree`] finds nearest points and what blocks a
//! line of sight.

pub mod calibration;
pub mod original;
pub mod random_views;
pub mod screen_error;
pub mod tree;
