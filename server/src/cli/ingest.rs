//! `ingest`: mesh files become models of a repository.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use lodestream_protocol::quant::{MAX_LATTICE_BITS, MIN_LATTICE_BITS};

use super::UsageError;
use super::choice::{Choice, parse};
use super::progress::ProgressLine;
use crate::ingest::read::read_mesh;
use crate::ingest::simplify::{BuildOptions, BuildStage, Progress};
use crate::ingest::{DEFAULT_CREASE_ANGLE_DEG, ingest};
use crate::mesh::TriMesh;
use crate::pack::{self, Metadata};
use crate::picture;
use crate::repository::{ModelId, Repository};

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
    /// Which collapse comes next.
    #[arg(long, default_value = Order::AVAILABLE[0].0, value_parser = parse::<Order>)]
    pub order: Order,
    /// What an op depends on.
    #[arg(long, default_value = Dependencies::AVAILABLE[0].0, value_parser = parse::<Dependencies>)]
    pub dependencies: Dependencies,
    /// What an op's visibility sphere bounds.
    #[arg(long, default_value = Spheres::AVAILABLE[0].0, value_parser = parse::<Spheres>)]
    pub spheres: Spheres,
    /// How the error of an op is measured.
    #[arg(long, default_value = ErrorBound::AVAILABLE[0].0, value_parser = parse::<ErrorBound>)]
    pub error: ErrorBound,
    /// Bits per coordinate [default: by the length of the mesh's edges].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(BITS))]
    pub bits: Option<u8>,
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
    for ((file, _), id) in models.iter().zip(&ids) {
        let started = Instant::now();
        let mut progress = ProgressLine::new(!args.json);
        progress.show("read", 0, None);
        let (mesh, read) = read_mesh(file).with_context(|| format!("cannot ingest {}", file.display()))?;
        let metadata = Metadata {
            title: if args.title.is_empty() { id.as_str().to_owned() } else { args.title.clone() },
            license: args.license.clone(),
            source: args.source.clone(),
            crease_angle_deg: DEFAULT_CREASE_ANGLE_DEG,
            read_report: serde_json::to_value(&read)?,
            ..Metadata::default()
        };
        let options = BuildOptions { bits: args.bits };
        let report = publish(&repository, id, mesh, metadata, &options, &mut progress)
            .with_context(|| format!("cannot ingest {}", file.display()))?;
        drop(progress);
        report.print(file, started.elapsed(), &read.not_carried, args.json)?;
    }
    Ok(())
}

/// What ingesting one mesh came to.
#[derive(Debug)]
pub(super) struct Published {
    id: ModelId,
    cleaned: crate::ingest::clean::CleanReport,
    built: crate::ingest::simplify::BuildReport,
    bytes: u64,
}

/// Cleans, builds and publishes a mesh.
///
/// # Errors
/// What building or the repository says.
pub(super) fn publish(
    repository: &Repository,
    id: &ModelId,
    mesh: TriMesh,
    metadata: Metadata,
    options: &BuildOptions,
    progress: &mut ProgressLine,
) -> anyhow::Result<Published> {
    let triangles = mesh.faces.len() as u64;
    progress.show("clean", 0, None);
    let done = ingest(mesh, options, &mut |step: Progress| {
        let stage = match step.stage {
            BuildStage::Prepare => "prepare",
            BuildStage::Simplify => "simplify",
            BuildStage::Assemble => "assemble",
        };
        progress.show(stage, (f64::from(step.fraction) * triangles as f64) as u64, Some(triangles));
    })?;
    progress.show("write", 0, None);
    // Times are left out of the pack: the same input gives the same bytes.
    let mut built = serde_json::to_value(&done.built)?;
    if let Some(fields) = built.as_object_mut() {
        fields.remove("timings");
    }
    let metadata = Metadata { clean_report: serde_json::to_value(&done.cleaned)?, build_report: built, ..metadata };
    let metadata = Metadata { leaves_room_for_thumbnail: true, ..metadata };
    let bytes = repository.publish_with_thumbnail::<_, anyhow::Error>(
        id,
        |out| Ok(pack::write(&done.dag, &done.complete, &metadata, out)?),
        |model| Ok(picture::thumbnail(model)?),
    )?;
    Ok(Published { id: id.clone(), cleaned: done.cleaned, built: done.built, bytes })
}

impl Published {
    /// Says on standard output what was made.
    pub(super) fn print(
        &self,
        file: &Path,
        elapsed: Duration,
        not_carried: &[String],
        as_json: bool,
    ) -> anyhow::Result<()> {
        let seconds = elapsed.as_secs_f64();
        let rate = self.built.triangles as f64 / seconds;
        if as_json {
            let line = serde_json::json!({
                "file": file.display().to_string(), "model": self.id.as_str(), "bytes": self.bytes,
                "seconds": seconds, "triangles_per_second": rate, "not_carried": not_carried,
                "clean": self.cleaned, "build": self.built,
            });
            println!("{line}");
            return Ok(());
        }
        let Self { id, built, bytes, .. } = self;
        println!(
            "{}: {} triangles, {} splits, {bytes} bytes in {seconds:.1} s ({:.2} M triangles/s)",
            id.as_str(),
            built.triangles,
            built.splits,
            rate / 1e6
        );
        println!("  base of {} triangles, {} spawns, {} bits", built.base_triangles, built.spawns, built.bits);
        println!("  {}", self.cleaned.to_string().trim_end().replace('\n', "\n  "));
        not_carried.iter().for_each(|what| println!("  not carried: {what}"));
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
    "endpoint" => Endpoint;
    later "midpoint", "subset", "optimal"
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
    Dependencies,
    /// The ops that made the faces on either side of its cut.
    "faces" => Faces;
    later "vertices"
}

choice! {
    /// What an op's visibility sphere bounds.
    Spheres,
    /// All that was split off from its vertex.
    "forest" => Forest;
    later "dag"
}

choice! {
    /// How the error of an op is measured.
    ErrorBound,
    /// Distance from the original surface.
    "deviation" => Deviation;
    later "edge"
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
    fn what_is_not_available_is_refused() {
        assert!(args("a.ply --repository r --placement optimal").unwrap_err().contains("not available yet"));
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
