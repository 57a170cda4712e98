//! `demo`: a sample model, ingested and served.

use std::net::SocketAddr;
use std::path::PathBuf;

/// Generate a sample model, ingest it and serve it.
#[derive(Clone, Debug, clap::Args)]
pub struct DemoArgs {
    /// Triangles of the sample, about.
    #[arg(long, value_name = "N", default_value_t = 1_000_000, value_parser = clap::value_parser!(u64).range(1..))]
    pub triangles: u64,
    /// Directory for the model, kept and used again by the next demo [default: a folder for temporary files].
    #[arg(long, value_name = "DIR")]
    pub repository: Option<PathBuf>,
    /// Address and port to listen on, 0 for a free port.
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8080")]
    pub listen: SocketAddr,
}
