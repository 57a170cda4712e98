//! The binary as an operator meets it: one ready line, clear refusals, exit codes, signals.
#![cfg(unix)]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

const BINARY: &str = env!("CARGO_BIN_EXE_lodestream-server");

/// A server that does not outlive its test.
struct Server(Child);

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// An empty folder, removed when dropped.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("lodestream-serve-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn output(args: &[&str]) -> (Option<i32>, String) {
    let Output { status, stderr, .. } = Command::new(BINARY).args(args).output().unwrap();
    (status.code(), String::from_utf8(stderr).unwrap())
}

#[test]
fn the_ready_line_names_the_address_and_a_signal_ends_the_server() {
    let folder = Folder::new("ready");
    let mut server = Command::new(BINARY);
    server.arg("serve").arg("--repository").arg(&folder.0).args(["--listen", "127.0.0.1:0"]);
    let mut server = Server(server.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap());
    let mut stdout = BufReader::new(server.0.stdout.take().unwrap());
    let mut line = String::new();
    stdout.read_line(&mut line).unwrap();
    let address = line.strip_prefix("listening on http://").unwrap().trim_end();

    let mut socket = TcpStream::connect(address).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    socket.write_all(b"GET /readyz HTTP/1.0\r\n\r\n").unwrap();
    let mut answer = String::new();
    socket.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.0 200") || answer.starts_with("HTTP/1.1 200"), "{answer}");

    assert!(Command::new("kill").args(["-TERM", &server.0.id().to_string()]).status().unwrap().success());
    assert!(server.0.wait().unwrap().success());
    let mut rest = String::new();
    stdout.read_to_string(&mut rest).unwrap();
    assert_eq!(rest, "", "the ready line is the only one");
    let mut log = String::new();
    server.0.stderr.take().unwrap().read_to_string(&mut log).unwrap();
    assert!(log.lines().all(|line| line.starts_with('{')) && log.contains("\"SIGTERM\""), "{log}");
}

#[test]
fn failures_exit_with_1_and_misuse_with_2() {
    let (code, text) = output(&["serve", "--repository", "/no/such/folder"]);
    assert_eq!(code, Some(1));
    assert!(
        text.starts_with("error: cannot open the repository /no/such/folder: ") && text.lines().count() == 1,
        "{text}"
    );
    let (code, text) = output(&["serve", "--repository", ".", "--config", "no-such-file.toml"]);
    assert_eq!(code, Some(1));
    assert!(text.starts_with("error: cannot read no-such-file.toml: "), "{text}");
    assert_eq!(output(&["serve"]).0, Some(2));
    assert_eq!(output(&["serve", "--repository", ".", "--listen", "nowhere"]).0, Some(2));
    assert_eq!(output(&["paint"]).0, Some(2));
}
