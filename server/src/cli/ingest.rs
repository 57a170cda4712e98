//! `ingest`: mesh files become models of a repository.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use lodestream_protocol::quant::{MAX_LATTICE_BITS, MIN_LATTICE_BITS};

use super::UsageError;
use super::choice::{Choice, parse};
use super::progress::ProgressLine;
use super::usage::Usage;
use crate::ingest::raw::RawMesh;
use crate::ingest::read::{ReadReport, read_mesh};
use crate::ingest::report::{BuildReport, Progress, Stage};
use crate::ingest::simplify::{BuildOptions, PlacementChoice};
use crate::ingest::spill::Workspace;
use crate::ingest::{DEFAULT_CREASE_ANGLE_DEG, Dependencies, ErrorRule, Precision, Resampled, Rules, Spheres, ingest};
use crate::pack::Metadata;
use crate::picture;
use crate::repository::{ModelId, Original, Repository};

/// Turn mesh files into models of a repository.
#[derive(Clone, Debug, clap::Args)]
pub struct IngestArgs {
    /// Mesh files; each becomes a model of its own.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Directory that holds the models; created if it does not exist.
    #[arg(long, value_name = "DIR")]
    pub repository: PathBuf,
    /// Name of the model in addresses [default: the file's stem].
    #[arg(long, value_name = "ID")]
    pub name: Option<String>,
    /// What a collapse costs.
    #[arg(long, default_value = Metric::AVAILABLE[0].0, value_parser = parse::<Metric>)]
    pub metric: Metric,
    /// Where the vertex that a collapse leaves lies.
    #[arg(long, default_value = Placement::AVAILABLE[0].0, value_parser = parse::<Placement>)]
    pub placement: Placement,
    /// Whether vertices keep their places or may slide along the surface to where they take fewer bytes.
    #[arg(long, default_value = PrecisionArg::AVAILABLE[0].0, value_parser = parse::<PrecisionArg>)]
    pub precision: PrecisionArg,
    /// Which collapse comes next.
    #[arg(long, default_value = Order::AVAILABLE[0].0, value_parser = parse::<Order>)]
    pub order: Order,
    /// What an op depends on.
    #[arg(long, default_value = DependenciesArg::AVAILABLE[0].0, value_parser = parse::<DependenciesArg>)]
    pub dependencies: DependenciesArg,
    /// What an op's visibility sphere bounds.
    #[arg(long, default_value = SpheresArg::AVAILABLE[0].0, value_parser = parse::<SpheresArg>)]
    pub spheres: SpheresArg,
    /// How the error of an op is measured.
    #[arg(long, default_value = ErrorArg::AVAILABLE[0].0, value_parser = parse::<ErrorArg>)]
    pub error: ErrorArg,
    /// Bits per coordinate [default: by the length of the mesh's edges].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(BITS))]
    pub bits: Option<u8>,
    /// Join vertices that are at most this far apart, in model units. Vertices at one place are always joined.
    #[arg(long, value_name = "DISTANCE", default_value_t = 0.0, value_parser = distance)]
    pub weld_tolerance: f64,
    /// Threads to work with [default: one per core].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Memory to stay under, such as 900MB or 2GiB; what does not fit goes to temporary files beside the models.
    #[arg(long, value_name = "SIZE", default_value = "4GiB", value_parser = byte_size)]
    pub memory_limit: u64,
    /// Keep a copy of the file beside the model.
    #[arg(long)]
    pub keep_original: bool,
    /// Name of the model for people.
    #[arg(long, default_value = "", hide_default_value = true)]
    pub title: String,
    /// Licence of the model.
    #[arg(long, default_value = "", hide_default_value = true)]
    pub license: String,
    /// Where the model comes from.
    #[arg(long, default_value = "", hide_default_value = true)]
    pub source: String,
    /// Print one JSON object for each model on standard output and no progress.
    #[arg(long)]
    pub json: bool,
}

/// Ingests the files one after the other; the first that fails ends it, and those before it are published.
///
/// # Errors
/// A file, the repository or a name that cannot be used; names the file.
pub fn run(args: IngestArgs) -> anyhow::Result<()> {
    let models = args.models()?;
    let ids: Vec<ModelId> = models
        .iter()
        .map(|(file, id)| id.parse().map_err(|error| UsageError(format!("{}: {error}; use --name", file.display()))))
        .collect::<Result<_, _>>()?;
    let repository = Repository::open_or_create(&args.repository)?;
    let plan = Plan::new(args.threads, args.memory_limit);
    for ((file, _), id) in models.iter().zip(&ids) {
        let started = Instant::now();
        let progress = ProgressLine::new(!args.json);
        let workspace = plan.workspace(&repository);
        progress.show("read", 0, None);
        let failed = || format!("cannot ingest {}", file.display());
        let (raw, read) = read_mesh(file, &workspace, &mut |bytes, all| progress.show("read", bytes, Some(all)))
            .with_context(failed)?;
        let original =
            args.keep_original.then(|| repository.keep_original(id, file)).transpose().with_context(failed)?;
        let metadata = Metadata {
            original: original.as_ref().map(|original| original.name().to_owned()).unwrap_or_default(),
            title: if args.title.is_empty() { id.as_str().to_owned() } else { args.title.clone() },
            license: args.license.clone(),
            source: args.source.clone(),
            crease_angle_deg: DEFAULT_CREASE_ANGLE_DEG,
            read_report: serde_json::to_value(&read)?,
            ..Metadata::default()
        };
        let options = BuildOptions {
            bits: args.bits,
            placement: args.placement.into(),
            weld_tolerance: args.weld_tolerance,
            precision: args.precision.into(),
            rules: Rules {
                dependencies: args.dependencies.into(),
                spheres: args.spheres.into(),
                error: args.error.into(),
            },
        };
        let input = Input { raw, metadata, original };
        let report = publish(&repository, id, input, &options, (&plan, &workspace), &progress).with_context(failed)?;
        drop(progress);
        report.print(file, started.elapsed(), &read, args.json)?;
    }
    Ok(())
}

/// How many threads work and how much memory they may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Plan {
    pub(super) threads: u32,
    memory_limit: u64,
}

impl Default for Plan {
    fn default() -> Self {
        Self::new(None, DEFAULT_MEMORY_LIMIT)
    }
}

const DEFAULT_MEMORY_LIMIT: u64 = 4 << 30;
/// What is held whatever the model and the number of threads, beside what spills keep.
const FIXED_MEMORY: u64 = 160 << 20;
/// What a thread needs to simplify one chunk.
const MEMORY_PER_THREAD: u64 = 100 << 20;
/// Most that is held per vertex of the input.
const MEMORY_PER_VERTEX: u64 = 16;

impl Plan {
    /// As many threads as there are cores, or as wanted, as far as memory goes.
    fn new(threads: Option<u32>, memory_limit: u64) -> Self {
        let cores = || std::thread::available_parallelism().map_or(1, |n| u32::try_from(n.get()).unwrap_or(u32::MAX));
        let room = memory_limit.saturating_sub(FIXED_MEMORY) / MEMORY_PER_THREAD;
        let threads = threads.unwrap_or_else(cores).min(u32::try_from(room).unwrap_or(u32::MAX)).max(1);
        Self { threads, memory_limit }
    }

    /// Where temporary data go: into memory up to a sixty-fourth of the limit, then into the repository's directory.
    pub(super) fn workspace(&self, repository: &Repository) -> Workspace {
        Workspace::new(repository.directory(), self.memory_limit / 64)
    }

    /// Whether a model of so many vertices can be ingested within the limit.
    ///
    /// # Errors
    /// States what it takes.
    fn check(&self, vertices: u64, rules: &Rules) -> anyhow::Result<()> {
        let per_vertex = MEMORY_PER_VERTEX + rules.bytes_per_vertex();
        let needed = FIXED_MEMORY + MEMORY_PER_THREAD + self.memory_limit / 64 + per_vertex * vertices;
        anyhow::ensure!(
            needed <= self.memory_limit,
            "{vertices} vertices take about {} MiB of memory, more than --memory-limit allows ({} MiB)",
            needed >> 20,
            self.memory_limit >> 20
        );
        Ok(())
    }
}

fn distance(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(distance) if distance >= 0.0 && distance.is_finite() => Ok(distance),
        _ => Err(format!("`{text}` is no distance: a number, not below zero")),
    }
}

/// A number of bytes: digits, perhaps with a fraction, and a unit.
fn byte_size(text: &str) -> Result<u64, String> {
    let digits = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(digits);
    let scale: f64 = match unit.trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1.0,
        "kb" => 1e3,
        "mb" => 1e6,
        "gb" => 1e9,
        "tb" => 1e12,
        "k" | "kib" => 1024.0,
        "m" | "mib" => 1024.0 * 1024.0,
        "g" | "gib" => 1024.0 * 1024.0 * 1024.0,
        "t" | "tib" => 1024.0 * 1024.0 * 1024.0 * 1024.0,
        _ => return Err(format!("`{unit}` is no unit; MB, MiB, GB and GiB are")),
    };
    match number.parse::<f64>() {
        Ok(number) if number > 0.0 => Ok((number * scale) as u64),
        _ => Err(format!("`{number}` is no number above zero")),
    }
}

/// A mesh and what to say of it.
#[derive(Debug)]
pub(super) struct Input {
    pub(super) raw: RawMesh,
    pub(super) metadata: Metadata,
    /// Copy of the source, to be kept beside the model.
    pub(super) original: Option<Original>,
}

/// What ingesting one mesh came to.
#[derive(Debug)]
pub(super) struct Published {
    id: ModelId,
    cleaned: crate::ingest::clean::CleanReport,
    built: BuildReport,
    bytes: u64,
}

/// Cleans, builds and publishes a mesh, with its original if it is kept.
///
/// # Errors
/// What building or the repository says.
pub(super) fn publish(
    repository: &Repository,
    id: &ModelId,
    input: Input,
    options: &BuildOptions,
    (plan, workspace): (&Plan, &Workspace),
    progress: &ProgressLine,
) -> anyhow::Result<Published> {
    let Input { raw, metadata, original } = input;
    let triangles = raw.triangles();
    plan.check(raw.vertices(), &options.rules)?;
    let show = |step: Progress| {
        let stage = match step.stage {
            Stage::Partition => "clean",
            Stage::Simplify => "simplify",
            Stage::Assemble => "assemble",
            Stage::Write => "write",
        };
        progress.show(stage, (f64::from(step.fraction) * triangles as f64) as u64, Some(triangles));
    };
    let done = ingest(raw, options, workspace, plan.threads, &show)?;
    // Times are left out of the pack: the same input gives the same bytes.
    let mut built = serde_json::to_value(&done.built)?;
    if let Some(fields) = built.as_object_mut() {
        fields.remove("timings");
    }
    let metadata = Metadata { clean_report: serde_json::to_value(&done.cleaned)?, build_report: built, ..metadata };
    let metadata = Metadata { leaves_room_for_thumbnail: true, ..metadata };
    let bytes = repository.publish_with_thumbnail::<_, anyhow::Error>(
        id,
        original,
        |out| Ok(done.write(&metadata, out, &show)?),
        |model| Ok(picture::thumbnail(model)?),
    )?;
    Ok(Published { id: id.clone(), cleaned: done.cleaned, built: done.built, bytes })
}

impl Published {
    /// Says on standard output what was made.
    pub(super) fn print(&self, file: &Path, elapsed: Duration, read: &ReadReport, as_json: bool) -> anyhow::Result<()> {
        let seconds = elapsed.as_secs_f64();
        let rate = self.built.triangles as f64 / seconds;
        if as_json {
            let line = serde_json::json!({
                "file": file.display().to_string(), "model": self.id.as_str(), "bytes": self.bytes,
                "seconds": seconds, "triangles_per_second": rate, "read": read,
                "clean": self.cleaned, "build": self.built, "usage": Usage::now(),
            });
            say!("{line}");
            return Ok(());
        }
        let Self { id, built, bytes, .. } = self;
        say!(
            "{}: {} triangles, {} splits, {bytes} bytes in {seconds:.1} s ({:.2} M triangles/s)",
            id.as_str(),
            built.triangles,
            built.splits,
            rate / 1e6
        );
        say!("  base of {} triangles, {} spawns, {} bits", built.base_triangles, built.spawns, built.bits);
        if let Some(Resampled { step, moved, largest }) = built.resampled {
            let step = step.map_or(1, |step| step.get());
            say!("  {moved} vertices moved to multiples of {step} lattice steps, by at most {largest:.1}");
        }
        say!("  {}", self.cleaned.to_string().trim_end().replace('\n', "\n  "));
        for what in &read.notes {
            say!("  {what}");
        }
        for what in &read.not_carried {
            say!("  not carried: {what}");
        }
        Ok(())
    }
}

const BITS: std::ops::RangeInclusive<i64> = MIN_LATTICE_BITS as i64..=MAX_LATTICE_BITS as i64;

impl IngestArgs {
    /// The files, each with the id of its model.
    ///
    /// # Errors
    /// When the files and `--name` do not go together, or a file's name is no id.
    pub fn models(&self) -> Result<Vec<(PathBuf, String)>, UsageError> {
        if let Some(name) = &self.name {
            return match self.files.as_slice() {
                [file] => Ok(vec![(file.clone(), name.clone())]),
                files => Err(UsageError(format!("--name names a single model, but there are {} files", files.len()))),
            };
        }
        let mut models: Vec<(PathBuf, String)> = Vec::with_capacity(self.files.len());
        for file in &self.files {
            let Some(id) = file.file_stem().and_then(|stem| stem.to_str()) else {
                return Err(UsageError(format!("{} gives the model no name; use --name", file.display())));
            };
            if let Some((other, _)) = models.iter().find(|(_, taken)| taken == id) {
                let (other, file) = (other.display(), file.display());
                return Err(UsageError(format!("{other} and {file} would both become the model `{id}`")));
            }
            models.push((file.clone(), id.to_owned()));
        }
        Ok(models)
    }
}

macro_rules! choice {
    ($(#[$doc:meta])* $name:ident, $($(#[$value_doc:meta])* $text:literal => $value:ident),+; later $($later:literal),*) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum $name {
            $($(#[$value_doc])* $value,)+
        }

        impl Choice for $name {
            const AVAILABLE: &'static [(&'static str, Self)] = &[$(($text, Self::$value)),+];
            const LATER: &'static [&'static str] = &[$($later),*];
        }
    };
}

choice! {
    /// What a collapse costs.
    Metric,
    /// Squared distance to the planes of the faces around (Garland and Heckbert 1997).
    "quadric" => Quadric;
    later "hybrid", "pm", "edge", "uvol"
}

choice! {
    /// Where the vertex that a collapse leaves lies.
    Placement,
    /// At one of the two ends.
    "endpoint" => Endpoint,
    /// In the middle.
    "midpoint" => Midpoint,
    /// At an end or in the middle, whichever is cheapest.
    "subset" => Subset,
    /// Where the quadric is least.
    "optimal" => Optimal;
    later
}

impl From<PrecisionArg> for Precision {
    fn from(precision: PrecisionArg) -> Self {
        match precision {
            PrecisionArg::Exact => Self::Exact,
            PrecisionArg::Visual => Self::Visual,
        }
    }
}

impl From<Placement> for PlacementChoice {
    fn from(placement: Placement) -> Self {
        match placement {
            Placement::Endpoint => Self::Endpoint,
            Placement::Midpoint => Self::Midpoint,
            Placement::Subset => Self::Subset,
            Placement::Optimal => Self::Optimal,
        }
    }
}

choice! {
    /// Whether vertices keep their places.
    PrecisionArg,
    /// Where they are, rounded to the lattice.
    "exact" => Exact,
    /// Moved along the surface, by a sixteenth of an edge or so, to where they take fewer bits.
    "visual" => Visual;
    later
}

choice! {
    /// Which collapse comes next.
    Order,
    /// Passes over the cheapest share of independent collapses.
    "batched" => Batched;
    later "linear", "drain"
}

choice! {
    /// What an op depends on.
    DependenciesArg,
    /// The ops that made the faces on either side of its cut.
    "faces" => Faces,
    /// The last ops on all vertices of those faces (Southern 2001).
    "vertices" => Vertices;
    later
}

impl From<DependenciesArg> for Dependencies {
    fn from(dependencies: DependenciesArg) -> Self {
        match dependencies {
            DependenciesArg::Faces => Self::Faces,
            DependenciesArg::Vertices => Self::Vertices,
        }
    }
}

choice! {
    /// What an op's visibility sphere bounds.
    SpheresArg,
    /// All that was split off from its vertex.
    "forest" => Forest,
    /// All ops that wait for it (Southern 2001).
    "dag" => Dag;
    later
}

impl From<SpheresArg> for Spheres {
    fn from(spheres: SpheresArg) -> Self {
        match spheres {
            SpheresArg::Forest => Self::Forest,
            SpheresArg::Dag => Self::Dag,
        }
    }
}

choice! {
    /// How the error of an op is measured.
    ErrorArg,
    /// Distance from the original surface.
    "deviation" => Deviation,
    /// Length of the collapsed edge (Southern 2001).
    "edge" => Edge;
    later
}

impl From<ErrorArg> for ErrorRule {
    fn from(error: ErrorArg) -> Self {
        match error {
            ErrorArg::Deviation => Self::Deviation,
            ErrorArg::Edge => Self::Edge,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Cli {
        #[command(flatten)]
        args: IngestArgs,
    }

    fn args(line: &str) -> Result<IngestArgs, String> {
        let words = ["ingest"].into_iter().chain(line.split_whitespace());
        Cli::try_parse_from(words).map(|cli| cli.args).map_err(|error| error.to_string())
    }

    #[test]
    fn defaults_are_the_first_values() {
        let args = args("a.ply --repository r").unwrap();
        assert_eq!((args.metric, args.placement, args.order), (Metric::Quadric, Placement::Endpoint, Order::Batched));
        assert_eq!((args.bits, args.json), (None, false));
    }

    #[test]
    fn memory_decides_how_many_threads_work() {
        assert_eq!(byte_size("4GiB"), Ok(DEFAULT_MEMORY_LIMIT));
        assert_eq!((byte_size("1.5 MB"), byte_size("700")), (Ok(1_500_000), Ok(700)));
        assert!(byte_size("4 parsecs").is_err() && byte_size("GiB").is_err() && byte_size("0MB").is_err());
        assert_eq!(Plan::new(Some(64), 1 << 30).threads, 8);
        let small = Plan::new(Some(3), 300 << 20);
        assert_eq!(small.threads, 1);
        assert!(small.check(1_000_000, &Rules::default()).is_ok());
        assert!(small.check(1_000_000, &Rules::PAPER).is_err());
        let error = small.check(10_000_000, &Rules::default()).unwrap_err().to_string();
        assert!(error.contains("10000000 vertices") && error.contains("300 MiB"), "{error}");
    }

    #[test]
    fn what_is_not_available_is_refused() {
        assert!(args("a.ply --repository r --metric hybrid").unwrap_err().contains("not available yet"));
        assert!(args("a.ply --repository r --bits 22").is_err());
        assert!(args("a.ply").is_err() && args("--repository r").is_err());
    }

    #[test]
    fn each_file_is_a_model() {
        let ids = |line| args(line).unwrap().models().map(|models| models.into_iter().map(|(_, id)| id).collect());
        assert_eq!(ids("x/a.ply b.tar.obj --repository r"), Ok(vec!["a".to_owned(), "b.tar".to_owned()]));
        assert_eq!(ids("a.ply --name c --repository r"), Ok(vec!["c".to_owned()]));
        let usage = |line| -> String { args(line).unwrap().models().unwrap_err().0 };
        assert!(usage("a.ply b.ply --name c --repository r").contains("2 files"));
        assert!(usage("a.ply x/a.obj --repository r").contains("a.ply and x/a.obj"));
    }
}
