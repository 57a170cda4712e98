//! Both cores on a virtual link and clock: a simulated hour runs in moments and repeats exactly.

mod link;
mod pair;
mod views;

pub use link::{Link, LinkShape};
pub use pair::{Disk, Pair, PairConfig};
pub use views::random_view;
