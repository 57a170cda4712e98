//! `demo`: a sample model, ingested and served.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Instant;

use super::ingest::{Input, Plan, publish};
use super::progress::ProgressLine;
use super::sample::sample_size;
use super::serve::{self, ServeArgs};
use crate::ingest::DEFAULT_CREASE_ANGLE_DEG;
use crate::ingest::raw::RawMesh;
use crate::ingest::sample::generate;
use crate::ingest::simplify::BuildOptions;
use crate::pack::Metadata;
use crate::repository::{ModelId, Repository};

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

/// Makes the sample unless an earlier demo has, says how to look at it, and serves it until a signal comes.
///
/// # Errors
/// A directory or an address that cannot be used.
pub fn run(args: DemoArgs) -> anyhow::Result<()> {
    let size = sample_size(args.triangles)?;
    let directory = args.repository.unwrap_or_else(|| std::env::temp_dir().join("lodestream-demo"));
    let repository = Repository::open_or_create(&directory)?;
    let id: ModelId = format!("fossils-{size}").parse().expect("the name above is a valid id");
    if repository.get(&id).is_err() {
        let started = Instant::now();
        let progress = ProgressLine::new(true);
        eprintln!("making a sample scan of about {size} triangles (once; kept in {})", directory.display());
        progress.show("sculpt", 0, None);
        let mesh = generate(size, 1);
        let metadata = Metadata {
            title: "Fossils in limestone (generated)".into(),
            license: "CC0-1.0".into(),
            source: "lodestream-server demo".into(),
            crease_angle_deg: DEFAULT_CREASE_ANGLE_DEG,
            ..Metadata::default()
        };
        let plan = Plan::default();
        let workspace = plan.workspace(&repository);
        let raw = RawMesh::of(&mesh, &workspace)?;
        drop(mesh);
        let input = Input { raw, metadata, original: None };
        publish(&repository, &id, input, &BuildOptions::default(), (&plan, &workspace), &progress)?;
        drop(progress);
        eprintln!("the model `{id}` is ready after {:.0} s", started.elapsed().as_secs_f64());
    }
    let note = move |address: std::net::SocketAddr| {
        eprintln!(
            "\nLook at the model in a browser:  http://{address}/models/{id}\n\
             Or take a picture, from the project's folder in another terminal:\n\n    \
             target/release/lodestream snapshot http://{address}/models/{id} --output view.png\n\n\
             Ctrl-C ends the server."
        );
    };
    let serve = ServeArgs { repository: directory, listen: Some(args.listen), config: None, viewer: None };
    serve::run_with(serve, note)
}
