//! `session_growth [--output FOLDER] [--sizes N,N..] [--sessions N,N..]`: how the costs of sessions grow. Server time for each view
//! of a moving camera against what is visible and against the size of the model, memory of a session against its client's
//! mesh, and many sessions on a real server. Writes `session-growth.md` with plots; prints the former.
//!
//! Models are generated scans, ingested by the real server and kept in a folder for temporary files.

mod many;
mod orbit;
mod plot;

use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context as _, ensure};
use lodestream_server::repository::{ModelId, Repository};
use lodestream_tests::server_process::{Running, described, server_bin};

use self::many::Crowd;
use self::orbit::{Held, Orbit};

/// Triangles of the models, for the growth with the model. The one before the last but one serves for the rest.
const SIZES: [u64; 6] = [100_000, 300_000, 1_000_000, 3_000_000, 8_000_000, 30_000_000];
/// The model whose visible part grows, and whose clients hold more and more.
const LARGE: u64 = 3_000_000;
/// Ops that a view asks for.
const VISIBLE: [usize; 7] = [1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 500_000];
/// Triangle limits of clients.
const LIMITS: [u32; 6] = [5_000, 20_000, 50_000, 100_000, 300_000, 1_000_000];
/// Sessions at once.
const SESSIONS: [u32; 6] = [1, 10, 100, 500, 1_000, 2_000];
/// The model that they look at.
const SHARED: u64 = 1_000_000;
/// How long it may take to make or to ingest a scan.
const LONG: Duration = Duration::from_secs(900);
/// Scanner noise of the samples, in mean edge lengths.
const NOISE: &str = "0.1";

fn main() -> anyhow::Result<()> {
    let mut words = std::env::args().skip(1);
    let (mut folder, mut sizes, mut sessions) = (PathBuf::from("."), SIZES.to_vec(), SESSIONS.to_vec());
    while let Some(word) = words.next() {
        let value = words.next().with_context(|| format!("{word} takes a value"))?;
        match word.as_str() {
            "--output" => folder = value.into(),
            "--sizes" => sizes = numbers(&value)?,
            "--sessions" => sessions = numbers(&value)?,
            flag => anyhow::bail!("{flag}: there are --output FOLDER, --sizes N,N.. and --sessions N,N.."),
        }
    }
    let models = Models::new()?;
    let mut found = Found::default();
    for &size in &sizes {
        found.by_size.push(Orbit::over_model(&models.get(size)?)?);
        eprintln!("{}", found.by_size.last().context("just pushed")?.row());
    }
    let large = models.get(LARGE)?;
    for ops in VISIBLE {
        let Some(orbit) = Orbit::with_visible(&large, ops)? else { continue };
        eprintln!("{}", orbit.row());
        found.by_visible.push(orbit);
    }
    for limit in LIMITS {
        found.held.push(Held::under(&large, limit)?);
    }
    models.get(SHARED)?;
    for &count in &sessions {
        let crowd = Crowd::measure(&models.folder, &name(SHARED), count)?;
        eprintln!("{}", crowd.row());
        found.crowds.push(crowd);
    }
    let text = found.described()?;
    std::fs::create_dir_all(&folder)?;
    std::fs::write(folder.join("session-growth.md"), &text)?;
    plot::write(&found, &folder)?;
    print!("{text}");
    Ok(())
}

fn numbers<N: std::str::FromStr>(list: &str) -> anyhow::Result<Vec<N>> {
    list.split(',').map(|n| n.parse().ok().with_context(|| format!("`{n}` is no number"))).collect()
}

fn name(triangles: u64) -> String {
    format!("noisy-{triangles}")
}

/// Generated scans in a repository.
struct Models {
    folder: PathBuf,
    repository: Repository,
}

impl Models {
    fn new() -> anyhow::Result<Self> {
        let folder = std::env::temp_dir().join("lodestream-session-growth");
        Ok(Self { repository: Repository::open_or_create(&folder)?, folder })
    }

    /// The scan of so many triangles, made if it is not there yet.
    fn get(&self, triangles: u64) -> anyhow::Result<orbit::Model> {
        let id: ModelId = name(triangles).parse()?;
        if !self.repository.path(&id).exists() {
            eprintln!("making a scan of {triangles} triangles");
            let file = self.folder.join("sample.ply");
            let file = file.to_str().context("the path is not UTF-8")?;
            let folder = self.folder.to_str().context("the path is not UTF-8")?;
            let count = triangles.to_string();
            for words in [
                &["sample", "--triangles", &count, "--noise", NOISE, file][..],
                &["ingest", file, "--repository", folder, "--name", id.as_str(), "--json"],
            ] {
                let output = Running::start(&server_bin(), words).wait(LONG);
                ensure!(output.status.success(), "{}", described(&output));
            }
            std::fs::remove_file(file)?;
        }
        Ok(self.repository.get(&id)?)
    }
}

/// All that was measured.
#[derive(Default)]
struct Found {
    by_size: Vec<Orbit>,
    by_visible: Vec<Orbit>,
    held: Vec<Held>,
    crowds: Vec<Crowd>,
}

impl Found {
    fn described(&self) -> anyhow::Result<String> {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let mut out = include_str!("head.md").replace("{cores}", &cores.to_string());
        let mut table = |title: &str, text: &str, head: &str, rows: Vec<String>| -> std::fmt::Result {
            writeln!(out, "\n## {title}\n\n{}\n\n{head}", text.trim_end())?;
            writeln!(out, "|{}", " ---: |".repeat(head.matches('|').count() - 1))?;
            rows.iter().try_for_each(|row| writeln!(out, "{row}"))
        };
        let rows = |orbits: &[Orbit]| orbits.iter().map(Orbit::row).collect();
        table("With what is visible", include_str!("visible.md"), Orbit::HEAD, rows(&self.by_visible))?;
        table("With the model", include_str!("size.md"), Orbit::HEAD, rows(&self.by_size))?;
        table("Memory", include_str!("memory.md"), Held::HEAD, self.held.iter().map(Held::row).collect())?;
        table("Many sessions", include_str!("many.md"), Crowd::HEAD, self.crowds.iter().map(Crowd::row).collect())?;
        Ok(out)
    }
}
