//! The figures of `lodestream load` against the real server: what clients count is what the server counts, runs repeat, and
//! what goes wrong is said.

use std::path::Path;

use lodestream_tests::meshes;
use lodestream_tests::server_process::{RUN_LIMIT, Running, ServerProcess, TempDir, client_bin, described, ingest};
use serde_json::Value;

fn serve(folder: &TempDir) -> ServerProcess {
    let repository = folder.join("repository");
    ingest(&[&folder.write_mesh("sphere", &meshes::colored_sphere(5))], &repository);
    ServerProcess::start(&repository)
}

/// Runs `lodestream load ... --json -`; exit code and figures.
fn load(server_process: &ServerProcess, model: &str, flags: &str) -> (i32, Value, String) {
    let url = server_process.url(model);
    let words = ["load", &url, "--json", "-"].into_iter().chain(flags.split_whitespace());
    let output = Running::start(&client_bin(), words).wait(RUN_LIMIT);
    let figures = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("no JSON: {}", described(&output)));
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    (output.status.code().expect("it was not killed"), figures, said)
}

fn count(figures: &Value, pointer: &str) -> u64 {
    let value = figures.pointer(pointer).and_then(Value::as_u64);
    value.unwrap_or_else(|| panic!("{pointer} is no number in {figures:#}"))
}

/// Sum over the sessions that ended of what the server logged.
fn logged(server_process: &ServerProcess, sessions: usize, field: &str) -> u64 {
    server_process.wait_for_log("session ends", sessions);
    let log = server_process.log();
    let lines = log.lines().filter(|line| line.contains("session ends"));
    let values = lines.map(|line| serde_json::from_str::<Value>(line).expect("the server logs JSON")[field].as_u64());
    values.map(|value| value.expect("a number")).sum()
}

/// A line of a recording: from the right, the farther the larger `x`.
fn view(time: f64, x: f64) -> String {
    format!("{{\"time\": {time}, \"eye\": [{x}, 0.5, 3.0], \"target\": [0, 0, 0], \"fov\": 40, \"tolerance\": 0.25}}\n")
}

fn recording(views: &str) -> String {
    format!("{{\"lodestream_path\": 1}}\n{views}")
}

#[test]
fn clients_and_server_count_the_same() {
    let folder = TempDir::new();
    let mut server_process = serve(&folder);
    // Moves for a second and rests until the end: a session that is interrupted at work would not log its sums.
    let mut views: String = (0..10u8).map(|i| view(f64::from(i) / 10.0, f64::from(i * 7 % 10) - 5.0)).collect();
    views += &view(60.0, 63.0 % 10.0 - 5.0);
    let path = folder.join("views.jsonl");
    std::fs::write(&path, recording(&views)).expect("the folder takes a file");
    let flags = format!("--clients 6 --ramp 0.2s --duration 4 --path {}", path.display());
    let (code, figures, said) = load(&server_process, "sphere", &flags);
    assert_eq!(code, 0, "{said}");
    for (field, pointer) in [
        ("bytes_sent", "/all/payload_in"),
        ("batches", "/all/batches"),
        ("splits", "/all/splits"),
        ("collapses", "/all/collapses"),
        ("views", "/all/views"),
    ] {
        let counted = count(&figures, pointer);
        assert!(counted > 0, "{field}");
        assert_eq!(logged(&server_process, 6, field), counted, "{field}");
    }
    server_process.check_healthy();
}

#[test]
fn figures_fit_together_and_repeat() {
    let folder = TempDir::new();
    let mut server_process = serve(&folder);
    let flags = "--clients 6 --ramp 0.2s --path jump --view-rate settled --triangles 4000 --tolerance 0.25 --seed 5";
    let (code, first, said) = load(&server_process, "sphere", flags);
    assert_eq!(code, 0, "{said}");
    let at = |pointer: &str| count(&first, pointer);
    assert_eq!((at("/clients/started"), at("/clients/completed"), at("/clients/failed")), (6, 6, 0));
    // Twenty views each, all of them waited for.
    for pointer in ["/all/views", "/all/views_settled", "/view_to_settled_ms/count", "/settled_error_px/count"] {
        assert_eq!(at(pointer), 120, "{pointer}");
    }
    for pointer in ["/connect_ms/count", "/first_image_ms/count", "/first_settled_ms/count", "/first_view/views"] {
        assert_eq!(at(pointer), 6, "{pointer}");
    }
    for name in ["bytes_in", "bytes_out", "splits", "cached_splits", "collapses", "batches"] {
        let part = |part: &str| at(&format!("/{part}/{name}"));
        assert_eq!(part("first_view") + part("moving"), part("all"), "{name}");
    }
    // Upgrades and the headers of frames come on top of payloads: 2 to 4 bytes each, 14 to a client's longest.
    let (bytes, payload, frames) = (at("/all/bytes_in"), at("/all/payload_in"), at("/all/frames"));
    assert!(bytes >= payload + 2 * frames + 6 * 100, "{bytes} {payload} {frames}");
    assert!(bytes <= payload + 4 * frames + 6 * 500, "{bytes} {payload} {frames}");
    assert!(at("/all/op_bytes") > 0 && at("/all/op_bytes") < payload);
    let collapses = first.pointer("/single_kind_batches/collapses").expect("it is always there");
    assert!(
        collapses["ops"].as_u64() <= first["all"]["collapses"].as_u64()
            && collapses["op_bytes"].as_u64() <= collapses["bytes"].as_u64()
    );
    // Every view needs ops, and the way from one to the next both kinds.
    assert!(at("/moving/splits") > 1000 && at("/moving/collapses") > 1000 && at("/all/cached_splits") > 0);
    // What each client went through adds up to the same along the time.
    let sum = |name: &str| {
        let moments = first["timeline"].as_array().expect("a list").iter();
        moments.map(|moment| moment[name].as_u64().expect("a number")).sum::<u64>()
    };
    assert_eq!((sum("splits"), sum("bytes_in")), (at("/all/splits"), at("/all/bytes_in")));
    // The limit binds and holds.
    assert!(at("/limited_views") > 0 && at("/max_triangles_seen") <= 4000 && at("/max_triangles_seen") > 3900);
    assert_eq!((at("/limits_exceeded"), at("/resets"), at("/dropped_batches")), (0, 0, 0));
    assert_eq!(first["stale_bytes"]["max"], 0.0, "who waits until it is settled gets nothing stale");

    // Settled views are a function of the path, and so is the way from one to the next, but for what the cache still holds.
    // Under a limit the way also depends on which pages the server had read.
    let figures = |flags: &str| load(&server_process, "sphere", flags).1;
    let flags = flags.replace("--triangles 4000", "--triangles unlimited");
    let [one, two, other] = [&flags, &flags, &flags.replace("--seed 5", "--seed 6")].map(|flags| figures(flags));
    for pointer in ["/all/splits", "/all/collapses", "/all/views", "/settled_error_px/max"] {
        assert_eq!(one.pointer(pointer), two.pointer(pointer), "{pointer}");
    }
    assert_ne!(one.pointer("/all/splits"), other.pointer("/all/splits"), "another seed is another path");
    server_process.check_healthy();
}

#[test]
fn an_orbit_over_a_slow_link_settles() {
    let folder = TempDir::new();
    let mut server_process = serve(&folder);
    let flags =
        "--clients 3 --view-rate 200 --tolerance 0.25 --rate 4Mbit --latency 10ms --stall 20ms/500ms --loss 0.01";
    let (code, figures, said) = load(&server_process, "sphere", flags);
    assert_eq!(code, 0, "{said}");
    let at = |pointer: &str| figures.pointer(pointer).and_then(Value::as_f64).expect("a number");
    // The last of the 360 views is waited for; the path is walked in 1.8 s at least.
    assert_eq!((at("/clients/completed"), at("/all/views_settled") >= 3.0), (3.0, true));
    assert!(at("/elapsed_s") >= 359.0 / 200.0, "{}", at("/elapsed_s"));
    // TCP and the upgrade take a round trip each, hello and welcome a third, the first view and its ops a fourth.
    assert!(at("/connect_ms/p50") >= 40.0 && at("/first_settled_ms/p50") >= 80.0);
    // So do later views, five milliseconds apart: what comes until then was made for earlier ones.
    assert!(at("/view_to_first_op_ms/p50") >= 20.0 && at("/stale_bytes/max") > 0.0);
    // No client gets more than its link carries, the last packet aside.
    let seconds = figures["timeline"].as_array().expect("a list").last().expect("not empty")["to_s"].as_f64().unwrap();
    assert!(at("/all/bytes_in") <= 3.0 * (seconds * 4e6 / 8.0 + 1448.0));
    server_process.check_healthy();
}

#[test]
fn a_recording_is_replayed() {
    let folder = TempDir::new();
    let server_process = serve(&folder);
    let path = folder.join("views.jsonl");
    // A view that is repeated is no new one.
    let views = [view(0.0, 0.0), view(0.1, 0.0), view(0.2, 2.0), view(0.3, 1.0)].concat();
    std::fs::write(&path, recording(&views)).expect("the folder takes a file");
    for pace in ["", "--view-rate settled", "--view-rate 20"] {
        let flags = format!("--clients 2 --path {} {pace}", path.display());
        let (code, figures, said) = load(&server_process, "sphere", &flags);
        assert_eq!(code, 0, "{said}");
        assert_eq!(count(&figures, "/all/views"), 6, "{pace}");
        let error = figures["settled_error_px"]["max"].as_f64().expect("a number");
        assert!(error > 0.0 && error <= 0.25, "the recording's tolerance, not the default: {error}");
    }

    // One view alone is set once, however long it lasts.
    std::fs::write(&path, recording(&view(0.0, 1.0))).expect("and another");
    let flags = format!("--duration 0.5 --view-rate settled --path {}", path.display());
    let (code, figures, said) = load(&server_process, "sphere", &flags);
    assert_eq!((code, count(&figures, "/all/views")), (0, 1), "{said}");

    std::fs::write(&path, recording(&view(0.0, 1.0).replace("fov", "fow"))).expect("and another");
    let url = server_process.url("sphere");
    let words = ["load", &url, "--path"].map(Path::new).into_iter().chain([&*path]);
    let output = Running::start(&client_bin(), words).wait(RUN_LIMIT);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && said.contains("line 2: unknown field `fow`"), "{said}");
}

#[test]
fn failures_are_counted_by_cause() {
    let folder = TempDir::new();
    let mut server_process = serve(&folder);
    let (code, figures, said) = load(&server_process, "nothing", "--clients 4");
    assert_eq!((code, count(&figures, "/clients/failures/no model 'nothing' on this server")), (1, 4), "{said}");
    assert_eq!(said, "error: 4 clients failed\n");

    // The base has more triangles than one.
    let (code, figures, said) = load(&server_process, "sphere", "--clients 2 --triangles 1");
    let failures = figures["clients"]["failures"].as_object().expect("an object");
    let (cause, times) = failures.iter().next().expect("there are some");
    assert!(code == 1 && failures.len() == 1 && times == 2 && cause.contains("smallest"), "{failures:?} {said}");
    server_process.check_healthy();

    // Nobody listens on a port that was free a moment ago.
    let free = std::net::TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    let url = format!("http://{}/models/sphere", free.expect("a port is free"));
    let page = folder.join("report.html");
    let words = ["load", &url, "--json", "-", "--report"].map(Path::new).into_iter().chain([&*page]);
    let output = Running::start(&client_bin(), words).wait(RUN_LIMIT);
    let figures: Value = serde_json::from_slice(&output.stdout).expect("figures all the same");
    let reason = figures["server_missing"].as_str().expect("a reason");
    assert!(output.status.code() == Some(1) && figures["server"].is_null(), "{}", described(&output));
    assert!(reason.starts_with("/metrics of the server cannot be read"), "{reason}");
    assert!(std::fs::read_to_string(&page).is_ok_and(|text| text.contains("No figures: /metrics of the server")));
}

#[test]
fn connections_that_break_are_made_anew_and_nothing_comes_twice() {
    let folder = TempDir::new();
    let mut server_process = serve(&folder);
    let flags = "--clients 6 --ramp 0.2s --path jump --view-rate settled --triangles unlimited --tolerance 0.25 \
                 --rate 2Mbit --latency 10ms";
    let run = |more: &str| {
        let (code, figures, said) = load(&server_process, "sphere", &format!("{flags} {more}"));
        assert_eq!(code, 0, "{more}: {said}");
        figures
    };
    let resumed_before = || {
        let page = server_process.get("/metrics");
        let value = |name: &str| {
            let line = page.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
            line.and_then(|text| text.parse::<u64>().ok()).unwrap_or_else(|| panic!("no {name}"))
        };
        (value("lodestream_resumptions_total{outcome=\"resumed\"}"), value("lodestream_sent_again_bytes_total"))
    };
    let whole = run("--seed 5");
    assert!(whole.get("dropped").is_none() && resumed_before() == (0, 0));

    // While batches are on their way. Connections that break within seconds, one after the other, would be waited for longer and longer.
    let often = run("--seed 5 --drop 1/1s");
    let at = |pointer: &str| count(&often, pointer);
    let (connections, resumed) = (at("/dropped/connections"), at("/dropped/resumed"));
    assert!(connections >= 3 && resumed + at("/dropped/begun_anew") == connections, "{}", often["dropped"]);
    assert_eq!(at("/dropped/time_to_answer_ms/count"), connections);
    // The shortest wait before a try, and four ways there and back: TCP, upgrade, claim.
    let least = often["dropped"]["time_to_answer_ms"]["p50"].as_f64().expect("there are samples");
    assert!(least >= 125.0 + 60.0, "{least}");
    let sent_again = often["dropped"]["sent_again_bytes"].as_f64().expect("the server says so");
    assert!(sent_again > 0.0 && sent_again < at("/all/payload_in") as f64 / 2.0, "{sent_again}");
    assert_eq!(resumed_before(), (resumed, sent_again as u64));

    // Each client once, between two views.
    let once = run("--seed 5 --drop 1");
    assert_eq!((count(&once, "/dropped/connections"), count(&once, "/dropped/resumed")), (6, 6));
    assert_eq!(once["options"]["drop_share"], 1.0);
    for figures in [&often, &once] {
        for pointer in ["/all/views_settled", "/all/splits", "/all/collapses", "/resets", "/clients/completed"] {
            assert_eq!(count(figures, pointer), count(&whole, pointer), "{pointer}");
        }
    }

    // Who is hit is drawn from the seed.
    let hit = |seed: u32| count(&run(&format!("--duration 1 --drop 0.5 --seed {seed}")), "/dropped/connections");
    let [one, again, other] = [21, 21, 22].map(hit);
    assert!(one == again && one != other, "{one} {again} {other}");
    server_process.check_healthy();
}

#[test]
fn a_report_shows_what_the_server_used_and_how_errors_fell() {
    let folder = TempDir::new();
    let mut server_process = serve(&folder);
    let page = folder.join("report.html");
    let flags = format!(
        "--clients 3 --path jump --view-rate settled --tolerance 0.25 --rate 2Mbit --seed 5 --report {}",
        page.display()
    );
    let (code, figures, said) = load(&server_process, "sphere", &flags);
    assert_eq!(code, 0, "{said}");
    let at = |pointer: &str| figures.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("{pointer}"));
    // Views rest before the server takes their last ops back, so twenty of them are read about more than once.
    assert!(at("/server/cpu_s") > 0.0 && at("/server/readings/0/at_s") < at("/server/readings/1/at_s"));
    assert_eq!((at("/server/sessions_peak"), at("/server/readings/0/sessions")), (3.0, 0.0));
    assert!(at("/server/session_bytes_per_session") > 0.0 && at("/server/clients_per_core") > 0.0);
    assert_eq!((at("/server/refused"), at("/server/resets")), (0.0, 0.0));
    assert!(figures.get("server_missing").is_none());

    // Curves begin with the base and end where the views settled.
    for view in ["first", "second"] {
        assert_eq!(at(&format!("/{view}_view_error/clients")), 3.0);
        for along in ["by_bytes", "by_time_ms"] {
            let curve = figures[format!("{view}_view_error")][along].as_array().expect("a list");
            let of = |point: &Value, name: &str| point[name].as_f64().expect("a number");
            for pair in curve.windows(2) {
                assert!(of(&pair[0], "at") < of(&pair[1], "at") && of(&pair[0], "p50") >= of(&pair[1], "p50"));
            }
            let last = curve.last().expect("not empty");
            assert!(of(&curve[0], "p90") > 1.0 && of(last, "p90") <= 0.25 && of(last, "p90") > 0.0, "{view} {along}");
        }
    }
    assert!(figures.get("error_curves_missing").is_none(), "{figures:#}");

    let text = std::fs::read_to_string(&page).expect("the page is there");
    assert!(text.contains("Error against bytes, second view") && text.contains("Memory of the server"));
    assert_eq!(text.matches("<svg").count(), 12);
    server_process.check_healthy();
}
