//! The native window shows what `snapshot` draws. It gets a display of its own; without Xvfb or a graphics adapter the tests
//! report themselves skipped.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use lodestream_tests::meshes;
use lodestream_tests::server_process::{ServerProcess, TempDir, client_bin, described, ingest, snapshot};

/// A display that nobody sees, gone when dropped.
struct Display {
    server: Child,
    name: String,
}

impl Display {
    fn open() -> Option<Self> {
        let started = Command::new("Xvfb")
            .args(["-displayfd", "1", "-screen", "0", "800x600x24", "-nolisten", "tcp"])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn();
        let Ok(mut server) = started else {
            eprintln!("skipped: no Xvfb");
            return None;
        };
        let mut number = String::new();
        BufReader::new(server.stdout.take().expect("piped")).read_line(&mut number).expect("Xvfb says its display");
        Some(Self { server, name: format!(":{}", number.trim()) })
    }

    fn view(&self, folder: &Path, args: &[&str]) -> Output {
        Command::new(client_bin())
            .arg("view")
            .args(args)
            .env("DISPLAY", &self.name)
            .env("XDG_RUNTIME_DIR", folder)
            .env_remove("WAYLAND_DISPLAY")
            .env_remove("WAYLAND_SOCKET")
            .output()
            .expect("the client runs")
    }
}

impl Drop for Display {
    fn drop(&mut self) {
        self.server.kill().ok();
        self.server.wait().ok();
    }
}

fn pixels(path: &Path) -> (u32, u32, Vec<u8>) {
    let file = BufReader::new(std::fs::File::open(path).expect("it was written"));
    let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
    let mut rgb = vec![0; reader.output_buffer_size().expect("of a size")];
    let info = reader.next_frame(&mut rgb).expect("whole");
    (info.width, info.height, rgb)
}

#[test]
fn the_window_shows_what_snapshot_draws() {
    let Some(display) = Display::open() else { return };
    let folder = TempDir::new();
    let mesh = folder.write_mesh("torus", &meshes::torus(60, 40));
    let repository = folder.join("repository");
    ingest(&[&mesh], &repository);
    let server = ServerProcess::start(&repository);
    let url = server.url("torus");
    let (expected, shown) = (folder.join("snapshot.png"), folder.join("window.png"));
    let words = ["--size", "320x240", "--occlusion", "0.8", "--output"].map(Path::new);
    let output = snapshot(&url, words.into_iter().chain([&*expected]));
    if described(&output).contains("no graphics adapter") {
        eprintln!("skipped: no graphics adapter");
        return;
    }
    assert!(output.status.success(), "{}", described(&output));
    let path = shown.to_str().expect("plain");
    // The background of snapshots has no gradient.
    let plain = format!("{url}#gradient=off");
    let output = display.view(folder.path(), &[&plain, "--size", "320x240", "--picture", path]);
    assert!(output.status.success(), "{}", described(&output));
    let ((width, height, a), (_, _, b)) = (pixels(&shown), pixels(&expected));
    assert_eq!((width, height), (320, 240));
    // The order in which ops came may round sums of normals otherwise.
    let off = a.iter().zip(&b).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(a.len() == b.len() && off <= Some(2), "{off:?}");
    assert!(a.iter().any(|&byte| byte > 150), "something is to be seen");

    // A device that is lost gives way to another, which draws the same.
    let again = folder.join("again.png");
    let args = [&plain, "--size", "320x240", "--lose-device", "--picture", again.to_str().expect("plain")];
    let output = display.view(folder.path(), &args);
    assert!(output.status.success(), "{}", described(&output));
    assert_eq!(pixels(&again).2, a, "what the new device draws");

    // A link to a view is one argument: with its part after the #.
    let edges = folder.join("edges.png");
    let link = format!("{url}#wireframe=on&occlusion=off");
    let output =
        display.view(folder.path(), &[&link, "--size", "320x240", "--picture", edges.to_str().expect("plain")]);
    assert!(output.status.success(), "{}", described(&output));
    assert_ne!(pixels(&edges).2, b, "edges are drawn");
}

#[test]
fn a_window_without_a_model_or_a_desktop_says_so() {
    let Some(display) = Display::open() else { return };
    let folder = TempDir::new();
    let repository = folder.join("repository");
    std::fs::create_dir(&repository).expect("a new folder");
    let server = ServerProcess::start(&repository);
    let picture = folder.join("none.png");
    let args = [&*server.url("nothing"), "--picture", picture.to_str().expect("plain")];
    let output = display.view(folder.path(), &args);
    let text = described(&output);
    assert!(!output.status.success() && !picture.exists());
    assert!(text.contains("no longer on the server") || text.contains("no graphics adapter"), "{text}");
    let nowhere = Display { server: Command::new("true").spawn().expect("it runs"), name: ":65000".into() };
    let output = nowhere.view(folder.path(), &args);
    assert_eq!(output.status.code(), Some(1));
    assert!(described(&output).contains("no desktop"), "{}", described(&output));
}
