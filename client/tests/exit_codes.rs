//! The real `lodestream` binary: 0 done, 1 failed, 2 usage, and no panic.

use std::process::{Command, Output};

fn lodestream(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_lodestream")).args(arguments).output().expect("the binary runs")
}

fn check(arguments: &[&str], code: i32, stderr: &str) {
    let output = lodestream(arguments);
    let said = String::from_utf8(output.stderr).expect("text");
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
    assert!(said.contains(stderr), "{arguments:?}: {said}");
    assert!(!said.contains("panicked"), "{said}");
}

#[test]
fn help_is_no_error() {
    check(&["--help"], 0, "");
    let help = lodestream(&["snapshot", "--help"]);
    let text = String::from_utf8(help.stdout).expect("text");
    for flag in
        "size eye target fov triangles tolerance complete rate latency until output export stats json".split(' ')
    {
        assert!(text.contains(&format!("--{flag} ")) || text.contains(&format!("--{flag}\n")), "--{flag}: {text}");
    }
}

#[test]
fn load_explains_its_flags() {
    let help = lodestream(&["load", "--help"]);
    let text = String::from_utf8(help.stdout).expect("text");
    for flag in
        "clients ramp duration path view-rate size fov triangles tolerance rate latency loss stall seed threads json"
            .split(' ')
    {
        assert!(text.contains(&format!("--{flag} ")), "--{flag}: {text}");
    }
}

#[test]
fn bad_usage_exits_with_2() {
    check(&[], 2, "Usage");
    check(&["snapshot"], 2, "<URL>");
    check(&["snapshot", "localhost"], 2, "does not begin with http://");
    check(&["snapshot", "http://localhost/models/x", "--rate", "fast"], 2, "no rate");
    check(&["snapshot", "http://localhost/models/x", "--eye", "1,2,3"], 2, "--target");
    check(&["snapshot", "http://localhost/models/x", "--eye", "1,2,3", "--target", "1,2,3"], 2, "same point");
}

#[test]
fn failures_exit_with_1() {
    // A port that was just free: nobody listens there.
    let port = std::net::TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("an address").port();
    let url = format!("http://127.0.0.1:{port}/models/x");
    check(&["snapshot", &url], 1, &format!("error: no server answers at 127.0.0.1:{port}"));
    check(&["snapshot", &url, "--stats", "no-such-folder/stats.json"], 1, "cannot write 'no-such-folder/stats.json'");
    check(&["load", &url, "--clients", "3"], 1, "error: 3 clients failed");
    check(&["load", &url, "--path", "no-such-file"], 1, "'no-such-file' is neither orbit, zoom, fly, jump nor a file");
    check(&["load", &url, "--json", "no-such-folder/out.json"], 1, "cannot write 'no-such-folder/out.json'");
}
