//! With the real binaries: a model is ingested and served, and `lodestream load` opens its address once, for the view of the
//! whole object (the bounding sphere fills the height, 1920x1080, 45 degrees), until that has settled.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};
use glam::DVec3;
use lodestream_server::pack::PackedModel;
use lodestream_tests::server_process::{RUN_LIMIT, Running, ServerProcess, TempDir, client_bin, described, server};
use serde_json::{Value, json};

use crate::{Options, Report, Subject, median};

/// A model in a repository, and its server.
pub(crate) struct Served {
    pub(crate) folder: TempDir,
    pub(crate) repository: PathBuf,
    pub(crate) process: ServerProcess,
    pub(crate) model: PackedModel,
}

impl Served {
    /// Name of the model.
    pub(crate) const ID: &str = "model";

    pub(crate) fn new(file: &Path, bits: u8) -> anyhow::Result<Self> {
        let folder = TempDir::new();
        let repository = folder.join("repository");
        let bits = bits.to_string();
        let words = ["ingest", "--json", "--name", Self::ID, "--bits", &bits, "--repository"].map(OsStr::new);
        let output = server(words.into_iter().chain([repository.as_os_str(), file.as_os_str()]));
        ensure!(output.status.success(), "{}", described(&output));
        let model = PackedModel::from_vec(std::fs::read(repository.join("model.lodepack"))?)?;
        let process = ServerProcess::start(&repository);
        Ok(Self { folder, repository, process, model })
    }
}

/// Row 4, over a link without delay.
pub(crate) fn first_image_bytes(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let opened = open(subject, options, &[])?;
    let value = median(opened.iter().map(|o| o.first_bytes).collect());
    report.line("4 bytes until the first image", &subject.name, value, "B", opened[0].described());
    Ok(())
}

/// Row 11, at 1 Mbit/s and a round trip of 100 ms.
pub(crate) fn first_image_time(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let opened = open(subject, options, &["--rate", "1Mbit", "--latency", "50ms"])?;
    let value = median(opened.iter().map(|o| o.first_ms / 1e3).collect());
    report.line("11 first image, 1 Mbit/s, 100 ms", &subject.name, value, "s", opened[0].described());
    Ok(())
}

/// Until the first image and until settled.
struct Opened {
    base_triangles: usize,
    first_bytes: f64,
    first_ms: f64,
    settled_bytes: f64,
    settled_ms: f64,
}

impl Opened {
    fn described(&self) -> Value {
        let Self { base_triangles, first_bytes, first_ms, settled_bytes, settled_ms } = self;
        json!({"base_triangles": base_triangles, "first_bytes": first_bytes, "first_ms": first_ms,
            "settled_bytes": settled_bytes, "settled_ms": settled_ms})
    }
}

fn open(subject: &Subject, options: &Options, link: &[&str]) -> anyhow::Result<Vec<Opened>> {
    let served = Served::new(&subject.file, options.bits)?;
    let (lo, hi) = subject.test.clean.bounding_box().context("the mesh has no vertices")?;
    let (lo, hi) = (DVec3::from_array(lo), DVec3::from_array(hi));
    let center = (lo + hi) / 2.0;
    let eye = center + DVec3::Z * ((hi - lo).length() / 2.0 / 22.5f64.to_radians().sin());
    let view = json!({"time": 0.0, "eye": eye.to_array(), "target": center.to_array(), "fov": 45.0});
    let path = served.folder.join("view");
    std::fs::write(&path, format!("{}\n{view}\n", json!({"lodestream_path": 1})))?;
    let url = served.process.url(Served::ID);
    let words = ["load", &url, "--json", "-", "--view-rate", "settled", "--triangles", "unlimited", "--path"];
    let words: Vec<&OsStr> =
        words.iter().map(OsStr::new).chain([path.as_os_str()]).chain(link.iter().map(OsStr::new)).collect();
    (0..options.runs)
        .map(|_| {
            let output = Running::start(&client_bin(), &words).wait(RUN_LIMIT);
            ensure!(output.status.success(), "{}", described(&output));
            let found: Value = serde_json::from_slice(&output.stdout).context("--json prints JSON")?;
            let field = |name: &str| found[name]["max"].as_f64().with_context(|| format!("the report has no {name}"));
            Ok(Opened {
                base_triangles: served.model.base().faces.len(),
                first_bytes: field("first_image_bytes")?,
                first_ms: field("first_image_ms")?,
                settled_bytes: field("first_settled_bytes")?,
                settled_ms: field("first_settled_ms")?,
            })
        })
        .collect()
}
