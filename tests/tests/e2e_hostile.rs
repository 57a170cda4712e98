//! Ends that vanish, files that rot and clients that lie: each ends its own session and nothing else.

use std::net::TcpStream;
use std::path::Path;
use std::process::Output;
use std::time::Duration;

use lodestream_tests::meshes;
use lodestream_tests::server_process::{
    ANSWER_LIMIT, RUN_LIMIT, Running, ServerProcess, TempDir, described, ingest, poll_until, server, snapshot,
    start_snapshot,
};
use tokio_tungstenite::tungstenite::{self, Message};

/// A server with the model `sphere`, large enough to take many seconds at [`SLOW`].
fn serve_sphere(folder: &TempDir) -> ServerProcess {
    let repository = folder.join("repository");
    ingest(&[&folder.write_mesh("sphere", &meshes::colored_sphere(6))], &repository);
    ServerProcess::start(&repository)
}

const SLOW: [&str; 5] = ["--complete", "--triangles", "unlimited", "--rate", "100kbit"];

/// A client that is in the middle of streaming.
fn start_slow(server_process: &ServerProcess) -> Running {
    let mut client = start_snapshot(&server_process.url("sphere"), SLOW);
    server_process.wait_for_log("session starts", 1);
    let is_over = poll_until(Duration::from_millis(500), || !client.is_running());
    assert!(!is_over, "the client should still stream: {}", described(&client.kill()));
    client
}

/// Exit code 1 and one line on standard error with one of `words`.
fn check_failure(output: &Output, words: &[&str]) {
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{}", described(output));
    assert!(message.starts_with("error: ") && message.lines().count() == 1, "{message}");
    assert!(!message.contains("panicked"), "{message}");
    assert!(words.iter().any(|word| message.contains(word)), "one of {words:?} in {message}");
}

fn check_streams(server_process: &ServerProcess, model: &str) {
    let output = snapshot(&server_process.url(model), ["--triangles", "5000", "--json"]);
    assert!(output.status.success(), "{}", described(&output));
    let stats: serde_json::Value = serde_json::from_slice(&output.stdout).expect("--json prints JSON");
    assert_eq!(stats["settled"], true);
}

#[test]
fn a_client_whose_server_dies_says_so() {
    let folder = TempDir::new();
    let mut server_process = serve_sphere(&folder);
    let client = start_slow(&server_process);
    server_process.kill();
    check_failure(&client.wait(RUN_LIMIT), &["connection to the server was lost"]);
    let output = snapshot(&server_process.url("sphere"), ["--json"]);
    check_failure(&output, &["no server answers"]);
}

#[test]
fn a_server_whose_client_dies_goes_on() {
    let folder = TempDir::new();
    let mut server_process = serve_sphere(&folder);
    let mut client = start_slow(&server_process);
    client.kill();
    server_process.wait_for_log("session ends", 1);
    check_streams(&server_process, "sphere");
    server_process.check_healthy();
}

#[test]
fn a_server_that_is_told_to_stop_says_goodbye() {
    let folder = TempDir::new();
    let mut server_process = serve_sphere(&folder);
    let client = start_slow(&server_process);
    server_process.terminate();
    let exit = server_process.wait();
    assert!(exit.success(), "{exit}: {}", server_process.log());
    check_failure(&client.wait(RUN_LIMIT), &["shutting down"]);
    assert!(!server_process.log().contains("panicked"), "{}", server_process.log());
}

/// Offset and length of the op pages, see `FORMAT.md`: a header of 32 bytes, then entries of 32 bytes.
fn op_pages(pack: &[u8]) -> (usize, usize) {
    const OP_PAGES: u64 = 7;
    let number = |at: usize, bytes: usize| {
        let mut word = [0; 8];
        word[..bytes].copy_from_slice(&pack[at..at + bytes]);
        u64::from_le_bytes(word)
    };
    let entry = (0..number(12, 4) as usize).map(|i| 32 + 32 * i).find(|&at| number(at, 4) == OP_PAGES);
    let entry = entry.expect("a pack has op pages");
    (number(entry + 8, 8) as usize, number(entry + 16, 8) as usize)
}

#[test]
fn rotten_packs_fail_alone() {
    let folder = TempDir::new();
    let repository = folder.join("repository");
    ingest(&[&folder.write_mesh("sound", &meshes::colored_sphere(5))], &repository);
    let pack = std::fs::read(repository.join("sound.lodepack")).expect("ingest published it");
    let (offset, bytes) = op_pages(&pack);
    let mut flipped = pack.clone();
    flipped[offset + bytes / 2] ^= 1;
    std::fs::write(repository.join("flipped.lodepack"), &flipped).expect("the folder takes a file");
    std::fs::write(repository.join("cut.lodepack"), &pack[..offset + bytes / 2]).expect("the folder takes a file");
    std::fs::write(repository.join("noise.lodepack"), vec![0x5a; 4096]).expect("the folder takes a file");

    let verify =
        |model: &str| server(["verify", model, "--repository"].into_iter().map(Path::new).chain([&*repository]));
    assert!(verify("sound").status.success());
    check_failure(&verify("flipped"), &["section op pages is damaged"]);
    check_failure(&verify("cut"), &["section header is damaged"]);
    check_failure(&verify("noise"), &["not a pack"]);

    let mut server_process = ServerProcess::start(&repository);
    let list = || -> Vec<(String, String)> {
        let answer = server_process.get("/models");
        let body = answer.split_once("\r\n\r\n").expect("a head and a body").1;
        let list: Vec<serde_json::Value> = serde_json::from_str(body).expect("a list in JSON");
        let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
        list.iter().map(|entry| (text(&entry["id"]), text(&entry["status"]))).collect()
    };
    let expected = |flipped: &str| {
        [("cut", "quarantined"), ("flipped", flipped), ("noise", "quarantined"), ("sound", "ready")]
            .map(|(id, status)| (id.to_owned(), status.to_owned()))
    };
    // Pages are checked when they are first used.
    assert_eq!(list(), expected("ready"));
    check_streams(&server_process, "sound");
    let stream = |model: &str| snapshot(&server_process.url(model), ["--complete", "--triangles", "unlimited"]);
    check_failure(&stream("flipped"), &["damaged"]);
    assert_eq!(list(), expected("quarantined"));
    check_failure(&stream("flipped"), &["cannot be used"]);
    check_failure(&stream("cut"), &["cannot be used"]);
    check_failure(&stream("noise"), &["cannot be used"]);
    check_streams(&server_process, "sound");
    server_process.check_healthy();
}

/// What the server's close frame says to a client that begins with `message`.
fn close_code(server_process: &ServerProcess, message: Message) -> u16 {
    let tcp = TcpStream::connect(server_process.authority()).expect("the server accepts connections");
    tcp.set_read_timeout(Some(ANSWER_LIMIT)).expect("a timeout above zero");
    let url = format!("ws://{}/models/sphere/stream", server_process.authority());
    let (mut socket, _) = tungstenite::client(url, tcp).expect("the server upgrades");
    socket.send(message).expect("the server takes a frame");
    loop {
        match socket.read() {
            Ok(Message::Close(frame)) => return frame.expect("the server says why").code.into(),
            Ok(_) => {}
            Err(error) => panic!("no close frame: {error}"),
        }
    }
}

#[test]
fn clients_that_send_garbage_are_closed_and_others_go_on() {
    let folder = TempDir::new();
    let mut server_process = serve_sphere(&folder);
    let mut other = start_slow(&server_process);
    let mut random = fastrand::Rng::with_seed(1);
    let noise: Vec<u8> = (0..600).map(|_| random.u8(..)).collect();
    for message in [
        Message::binary(noise),
        Message::binary(vec![0xff; 40]),
        Message::binary(Vec::new()),
        Message::binary(vec![0; 1 << 20]),
        Message::text("hello"),
    ] {
        let shown = format!("{message:?}").chars().take(60).collect::<String>();
        assert_eq!(close_code(&server_process, message), 4000, "{shown}");
    }
    assert!(other.is_running(), "{}", described(&other.kill()));
    check_streams(&server_process, "sphere");
    server_process.check_healthy();
}
