//! Command line of the Lodestream client.

fn main() {}
