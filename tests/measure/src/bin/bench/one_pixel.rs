//! Row 5, with the real binaries.
//!
//! Each case looks for the largest tolerance at which `lodestream snapshot --export` holds, once settled, a mesh whose real screen
//! error (p99.9 of unoccluded vertices at 1920x1080, 45 degrees) is at most one pixel; its bytes are everything received from
//! cold. `--until bytes:N` would stop at the end of a frame, which is up to half of what these views need. The mesh is judged once
//! more by `lodestream-server screen-error`. The curve of bytes against error is that of the tolerances of [`CURVE_PX`].

use std::cell::RefCell;
use std::ffi::OsStr;
use std::path::Path;

use anyhow::{Context as _, ensure};
use glam::DVec3;
use lodestream_protocol::view::View;
use lodestream_server::ingest::read::read_mesh_in_memory;
use lodestream_server::judge::original::{Original, Shown};
use lodestream_server::judge::screen_error::{Candidate, Percentiles, findings};
use lodestream_server::pack::extract_complete;
use lodestream_tests::server_process::{ServerProcess, TempDir, described, server, snapshot};
use serde_json::{Value, json};

use crate::live::Served;
use crate::{Options, Report, Subject};

/// Tolerances between which the largest that will do is looked for, in pixels.
const TOLERANCES_PX: [f64; 2] = [0.25, 4.0];
/// Tolerances whose bytes and errors are told, too, in pixels.
const CURVE_PX: [f64; 5] = [0.5, 1.0, 2.0, 4.0, 8.0];
/// Halvings of that interval, by ratio: 2 % are left.
const HALVINGS: u32 = 7;

/// Six azimuths, both distances.
pub(crate) fn measure(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let Served { folder, repository, process, model } = &Served::new(&subject.file, options.bits)?;
    // Judged against what complete refinement gives, which is a file too, for the command.
    let complete = folder.join("complete.ply");
    let words = ["export", Served::ID, "--repository"].map(OsStr::new);
    let output = server(words.into_iter().chain([repository.as_os_str(), "--output".as_ref(), complete.as_os_str()]));
    ensure!(output.status.success(), "{}", described(&output));
    let original = Original::new(&extract_complete(model)?);
    let case = &subject.name;
    let whole = original.radius() / 22.5f64.to_radians().sin();
    for (name, distance) in [("whole", whole), ("close", 0.95 * original.radius())] {
        let mut total = 0.0;
        let mut curve = [[0.0; 2]; CURVE_PX.len()];
        for step in 0..6 {
            let azimuth = step * 60;
            let angle = f64::from(azimuth).to_radians();
            let eye = original.center() + DVec3::new(angle.sin(), 0.0, angle.cos()) * distance;
            let mut view = View::perspective(eye, original.center(), 45f32.to_radians());
            view.near = original.radius() * 1e-3;
            let shown = original.shown(&view).into_iter().filter(|s| s.is_unoccluded).collect();
            let search = Search { process, original: &original, view, shown, folder, known: RefCell::default() };
            let (tolerance, stats, error) = search.fewest_bytes()?;
            let again =
                search.command(&complete)?["unoccluded"]["p999"].as_f64().context("screen-error prints p999")?;
            ensure!((again - error.p999).abs() < 1e-3, "screen-error says {again}, not {}", error.p999);
            let bytes = stats["bytes_received"].as_f64().context("--stats has bytes_received")?;
            total += bytes;
            let more = json!({"tolerance_px": tolerance, "triangles": stats["triangles"], "p999_px": error.p999,
                "max_px": error.max});
            report.line("5 bytes to 1 px", &format!("{case}/{name}/{azimuth}"), bytes, "B", more);
            for (tolerance, point) in CURVE_PX.into_iter().zip(&mut curve) {
                let (stats, error) = search.run(tolerance)?;
                let bytes = stats["bytes_received"].as_f64().context("--stats has bytes_received")?;
                let more = json!({"p999_px": error.p999, "max_px": error.max, "triangles": stats["triangles"]});
                let case = format!("{case}/{name}/{azimuth}/{tolerance} px");
                report.line("5 bytes at a tolerance", &case, bytes, "B", more);
                *point = [point[0] + bytes, point[1] + error.p999];
            }
        }
        for (tolerance, [bytes, p999]) in CURVE_PX.into_iter().zip(curve) {
            let case = format!("{case}/{name}/{tolerance} px");
            let more = json!({"p999_px": p999 / 6.0});
            report.line("5 bytes at a tolerance, mean of azimuths", &case, bytes / 6.0, "B", more);
        }
        report.line("5 bytes to 1 px, mean of azimuths", &format!("{case}/{name}"), total / 6.0, "B", Value::Null);
    }
    Ok(())
}

struct Search<'a> {
    process: &'a ServerProcess,
    original: &'a Original,
    view: View,
    shown: Vec<Shown>,
    folder: &'a TempDir,
    /// Runs so far: the search comes by some tolerances of the curve.
    known: RefCell<Vec<(f64, Value, Percentiles)>>,
}

impl Search<'_> {
    /// Tolerance, statistics and error of the run with the fewest bytes that reaches one pixel; its mesh is left as `best.ply`.
    fn fewest_bytes(&self) -> anyhow::Result<(f64, Value, Percentiles)> {
        let [mut low, mut high] = TOLERANCES_PX;
        let (stats, error) = self.run(low)?;
        ensure!(error.p999 <= 1.0, "a tolerance of {low} px leaves {} px", error.p999);
        let mut best = (low, stats, error);
        for _ in 0..HALVINGS {
            let middle = (low * high).sqrt();
            let (stats, error) = self.run(middle)?;
            if error.p999 <= 1.0 {
                best = (middle, stats, error);
                low = middle;
            } else {
                high = middle;
            }
        }
        Ok(best)
    }

    /// Statistics and error at a tolerance, which is asked for once.
    fn run(&self, tolerance: f64) -> anyhow::Result<(Value, Percentiles)> {
        let known = self.known.borrow().iter().find(|run| run.0 == tolerance).map(|run| (run.1.clone(), run.2));
        if let Some(known) = known {
            return Ok(known);
        }
        let (stats, error) = self.ask(tolerance)?;
        self.known.borrow_mut().push((tolerance, stats.clone(), error));
        Ok((stats, error))
    }

    fn ask(&self, tolerance: f64) -> anyhow::Result<(Value, Percentiles)> {
        let (eye, target) = self.pose();
        let mesh = self.folder.join("mesh.ply");
        let tolerance = tolerance.to_string();
        let words = ["--size", "1920x1080", "--fov", "45", "--triangles", "unlimited", "--json"];
        let rest = ["--tolerance", &tolerance, "--eye", &eye, "--target", &target, "--export"];
        let words = words.into_iter().chain(rest).map(OsStr::new);
        let output = snapshot(&self.process.url(Served::ID), words.chain([mesh.as_os_str()]));
        ensure!(output.status.success(), "{}", described(&output));
        let stats = serde_json::from_slice(&output.stdout).context("--json prints JSON")?;
        let candidate = Candidate::new(&read_mesh_in_memory(&mesh)?.0);
        let found = findings(self.original, &self.shown, &candidate, &self.view);
        let error = Percentiles::of(&mut found.iter().map(|f| f.pixels).collect::<Vec<_>>());
        if error.p999 <= 1.0 {
            std::fs::rename(&mesh, self.folder.join("best.ply"))?;
        }
        Ok((stats, error))
    }

    fn pose(&self) -> (String, String) {
        let text = |[x, y, z]: [f64; 3]| format!("{x:?},{y:?},{z:?}");
        (text(self.view.eye), text(self.original.center().to_array()))
    }

    /// What `screen-error` says about the best mesh.
    fn command(&self, complete: &Path) -> anyhow::Result<Value> {
        let (eye, target) = self.pose();
        let mesh = self.folder.join("best.ply");
        let words =
            ["--size", "1920x1080", "--fov", "45", "--json", "--eye", &eye, "--target", &target].map(OsStr::new);
        let files = ["screen-error".as_ref(), complete.as_os_str(), mesh.as_os_str()];
        let output = server(files.into_iter().chain(words));
        ensure!(output.status.success(), "{}", described(&output));
        serde_json::from_slice(&output.stdout).context("--json prints JSON")
    }
}
