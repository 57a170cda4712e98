//! `bench [ROW...] [FILE...] [--json] [--bits N] [--precision exact|visual] [--runs N]`: the figures of TARGETS.md, one line each, as a table or as JSON
//! objects `{"name", "value", "unit", "case"}` with what else there is to say about a figure in further fields.
//!
//! Rows are numbers. Without any, all of [`ROWS`] but those that take minutes. Models are the files named; else those of
//! [`MESHES`] in the folder `LODESTREAM_MESHES`; else generated ones. `--bits` are those of a coordinate, 14 as in the anchors.
//!
//! `wire` reads recorded sessions, `in_process` runs both ends in this process, `visibility` judges ops, `live` the real binaries, `one_pixel` looks for
//! the fewest bytes with these. Every figure is of work whose outcome was checked: counts of triangles, digests of both ends,
//! errors in pixels. Times are processor times, medians of `--runs` runs.

mod in_process;
mod live;
mod one_pixel;
mod visibility;
mod wire;

use std::cell::Cell;
use std::path::PathBuf;

use anyhow::{Context as _, bail, ensure};
use lodestream_server::ingest::sample;
use lodestream_server::ingest::simplify::{BuildOptions, Precision};
use lodestream_server::mesh::TriMesh;
use lodestream_tests::meshes;
use lodestream_tests::model::TestModel;
use lodestream_tests::server_process::TempDir;
use lodestream_tests::source::Source;
use serde_json::{Map, Value, json};

/// Rows that can be measured, and what they are.
const ROWS: [(u32, &str); 15] = [
    (1, "bits per split, complete from cold"),
    (2, "bits per split, moving"),
    (3, "bits per cached split and per collapse"),
    (4, "bytes until the first image"),
    (5, "bytes until one pixel (takes minutes)"),
    (6, "ops against the vertex-tree minimum"),
    (7, "bits per split for colour"),
    (8, "bytes per split in the pack"),
    (11, "time until the first image at 1 Mbit/s, 100 ms"),
    (12, "node tests, warm, one core"),
    (13, "server, select + mirror + encode"),
    (14, "server time per view update"),
    (16, "client, decode + apply"),
    (18, "server memory, moving and at rest"),
    (22, "screen error over random views (takes minutes)"),
];
/// Rows that have to be asked for.
const SLOW: [u32; 2] = [5, 22];
/// The models that the targets name; rows other than 7 leave out the last one, for its colours.
const MESHES: [&str; 4] = ["bunny.ply", "armadillo.ply", "dragon_871k.ply", "gargo.ply"];
/// Stand in for them.
const MADE: [Source; 3] = [
    Source::Made("noisy-sphere-70k", || meshes::noisy_sphere(70_000, 1)),
    Source::Made("stone-300k", || TriMesh { colors: None, ..sample::generate(300_000, 0) }),
    Source::Made("stone-50k", || sample::generate(50_000, 0)),
];

fn main() -> anyhow::Result<()> {
    let Asked { rows, files, options, as_json } = Asked::parse(std::env::args().skip(1))?;
    let report = Report { as_json, has_begun: Cell::new(false) };
    let only_rows_without_colors = files.is_empty();
    let sources = if files.is_empty() { Source::of_targets(&MESHES, &MADE)? } else { Source::of_files(files) };
    for source in &sources {
        let subject = Subject::new(source, &options)?;
        for &row in &rows {
            let is_colored = subject.test.clean.colors.is_some();
            let is_left_out = if row == 7 { !is_colored } else { is_colored && only_rows_without_colors };
            if !is_left_out {
                measure(row, &subject, &options, &report).with_context(|| format!("row {row}, {}", subject.name))?;
            }
        }
    }
    Ok(())
}

fn measure(row: u32, subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    match row {
        1 => wire::complete(subject, report),
        2 => wire::moving(subject, report),
        3 => wire::again_and_back(subject, report),
        4 => live::first_image_bytes(subject, options, report),
        5 => one_pixel::measure(subject, options, report),
        6 => in_process::closures(subject, options, report),
        7 => wire::color(subject, report),
        8 => wire::pack(subject, report),
        11 => live::first_image_time(subject, options, report),
        12 => visibility::measure(subject, options, report),
        13 => in_process::server(subject, options, report),
        14 => in_process::view_updates(subject, report),
        16 => in_process::client(subject, options, report),
        18 => in_process::memory(subject, options, report),
        22 => in_process::calibration(subject, options, report),
        _ => bail!("row {row} cannot be measured here"),
    }
}

/// How to measure.
struct Options {
    /// Bits of a coordinate.
    bits: u8,
    /// Of the models.
    precision: Precision,
    /// Runs, of which the median counts.
    runs: usize,
    /// Random views.
    views: usize,
}

/// What the command line says.
struct Asked {
    rows: Vec<u32>,
    files: Vec<PathBuf>,
    options: Options,
    as_json: bool,
}

impl Asked {
    fn parse(mut words: impl Iterator<Item = String>) -> anyhow::Result<Self> {
        let options = Options { bits: 14, precision: Precision::Exact, runs: 5, views: 40 };
        let mut asked = Self { rows: Vec::new(), files: Vec::new(), options, as_json: false };
        while let Some(word) = words.next() {
            if word == "--precision" {
                asked.options.precision = match words.next().as_deref() {
                    Some("exact") => Precision::Exact,
                    Some("visual") => Precision::Visual,
                    _ => bail!("--precision is exact or visual"),
                };
                continue;
            }
            let mut number = || -> anyhow::Result<usize> {
                let text = words.next().with_context(|| format!("{word} takes a number"))?;
                text.parse().with_context(|| format!("{word} {text}: no number"))
            };
            match word.as_str() {
                "--json" => asked.as_json = true,
                "--bits" => asked.options.bits = u8::try_from(number()?).context("--bits is from 8 to 21")?,
                "--runs" => asked.options.runs = number()?.max(1),
                "--views" => asked.options.views = number()?.max(1),
                flag if flag.starts_with('-') => {
                    bail!("{flag}: there are --json, --bits N, --precision exact|visual, --runs N and --views N")
                }
                word => match word.parse() {
                    Ok(row) => {
                        let known = || ROWS.map(|(row, what)| format!("\n  {row:2} {what}")).concat();
                        ensure!(ROWS.iter().any(|r| r.0 == row), "there is no row {row}, only{}", known());
                        asked.rows.push(row);
                    }
                    Err(_) => asked.files.push(word.into()),
                },
            }
        }
        if asked.rows.is_empty() {
            asked.rows = ROWS.iter().map(|r| r.0).filter(|row| !SLOW.contains(row)).collect();
            eprintln!("rows {SLOW:?} take minutes and are measured when asked for");
        }
        Ok(asked)
    }
}

/// A model to measure.
struct Subject {
    name: String,
    test: TestModel,
    file: PathBuf,
    /// Keeps a generated mesh's file.
    _folder: Option<TempDir>,
}

impl Subject {
    fn new(source: &Source, options: &Options) -> anyhow::Result<Self> {
        let mesh = source.mesh()?;
        let (file, folder) = match source {
            Source::File(file) => (file.clone(), None),
            Source::Made(name, _) => {
                let folder = TempDir::new();
                (folder.write_mesh(name, &mesh), Some(folder))
            }
        };
        let build = BuildOptions { bits: Some(options.bits), precision: options.precision, ..BuildOptions::default() };
        Ok(Self { name: source.name(), test: TestModel::with_options(mesh, &build), file, _folder: folder })
    }
}

/// Where figures go.
struct Report {
    as_json: bool,
    /// Whether the table has begun.
    has_begun: Cell<bool>,
}

impl Report {
    /// A figure; `more` holds what it is made of.
    fn line(&self, name: &str, case: &str, value: f64, unit: &str, more: Value) {
        let more = if let Value::Object(more) = more { more } else { Map::new() };
        if self.as_json {
            let mut line = json!({"name": name, "value": value, "unit": unit, "case": case});
            line.as_object_mut().expect("an object").extend(more);
            println!("{line}");
            return;
        }
        if !self.has_begun.replace(true) {
            println!("{:46} {:24} {:>12} {:10}", "figure", "case", "value", "unit");
        }
        let more: Vec<String> = more.iter().map(|(key, value)| format!("{key} {}", short(value))).collect();
        println!("{name:46} {case:24} {:>12} {unit:10} {}", short(&value.into()), more.join(", "));
    }
}

/// A number with as many places as matter.
fn short(value: &Value) -> String {
    match value.as_f64() {
        Some(x) if value.is_f64() && x.abs() < 1000.0 => format!("{x:.3}"),
        Some(x) => format!("{x:.0}"),
        None => value.as_str().map_or_else(|| value.to_string(), str::to_owned),
    }
}

/// The middle one.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
