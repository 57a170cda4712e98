//! `serve`: the repository's models on one port until a signal says stop.

use std::io::Write as _;
use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::Context as _;

use crate::config::Config;
use crate::http::models::RepositoryModels;
use crate::http::{self, App, Drained, Viewer};
use crate::repository::Repository;
use crate::runtime::{Shutdown, block_on};
use crate::telemetry;

/// Serve a repository's models.
///
/// Prints `listening on http://ADDRESS` once it accepts clients. SIGINT and SIGTERM close all sessions and end it; a second
/// one ends it at once.
#[derive(Clone, Debug, clap::Args)]
pub struct ServeArgs {
    /// Directory that holds the models.
    #[arg(long, value_name = "DIR")]
    pub repository: PathBuf,
    /// Address and port to listen on, 0 for a free port [default: 127.0.0.1:8080].
    #[arg(long, value_name = "ADDRESS:PORT")]
    pub listen: Option<SocketAddr>,
    /// Configuration; deploy/server.toml lists every key.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Viewer for browsers, as `cargo xtask browser` makes it [default: the one that this program was built with].
    #[arg(long, value_name = "DIR")]
    pub viewer: Option<PathBuf>,
}

/// Serves until a signal comes.
///
/// # Errors
/// A configuration, a directory or an address that cannot be used.
pub fn run(args: ServeArgs) -> anyhow::Result<()> {
    run_with(args, |_| {})
}

/// [`run`], calling `note` with the address once it accepts clients.
pub(super) fn run_with(args: ServeArgs, note: impl FnOnce(SocketAddr)) -> anyhow::Result<()> {
    let mut config = Config::load(args.config.as_deref(), variables())?;
    if let Some(listen) = args.listen {
        config.http.listen = listen;
    }
    let (settings, session) = (config.settings()?, config.session()?);
    telemetry::start(config.log.format, &config.log.filter)?;
    let repository = Repository::open(&args.repository)?;
    let models = RepositoryModels::new(repository, session);
    let viewer = match &args.viewer {
        Some(folder) => Viewer::from_folder(folder).with_context(|| format!("no viewer in '{}'", folder.display()))?,
        None => Viewer::embedded(),
    };
    let shutdown = Shutdown::default();
    let app =
        App::new(Box::new(models), viewer, settings, shutdown.clone()).context("cannot start the compute threads")?;
    let io_threads = config.runtime.io_threads as usize;
    block_on(io_threads, serve(app, config.http.listen, shutdown, note)).context("cannot start the server's threads")?
}

async fn serve(
    app: std::sync::Arc<App>,
    listen: SocketAddr,
    shutdown: Shutdown,
    note: impl FnOnce(SocketAddr),
) -> anyhow::Result<()> {
    shutdown.follow_signals().context("cannot handle signals")?;
    let listener =
        http::bind(listen).await.with_context(|| format!("cannot listen on {listen} (--listen names another)"))?;
    let address = listener.local_addr()?;
    let mut stdout = std::io::stdout();
    writeln!(stdout, "listening on http://{address}").and_then(|()| stdout.flush()).context("standard output")?;
    note(address);
    tracing::info!(%address, "listening");
    match http::serve(listener, app).await {
        Drained::Completely => tracing::info!("all sessions are closed"),
        Drained::Partly { sessions } => tracing::warn!(sessions, "sessions were cut off"),
    }
    Ok(())
}

/// The environment, as far as it is text.
fn variables() -> impl Iterator<Item = (String, String)> {
    std::env::vars_os().filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)))
}
