//! The server as clients meet it: real sockets on this machine, sessions that a test controls.

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use lodestream_protocol::limits::MAX_CLIENT_FRAME_BYTES;
use lodestream_protocol::message::CloseCode;
use lodestream_protocol::time::Timestamp;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::{self, Message};
use tokio_tungstenite::{WebSocketStream, client_async};

use super::*;
use crate::runtime::Core;
use crate::session::{SessionError, SessionStats};

/// No test takes longer.
const PATIENCE: Duration = Duration::from_secs(20);

/// Sends every frame back. A frame `panic` panics, `fail` fails.
#[derive(Default)]
struct Echo {
    frames: VecDeque<Vec<u8>>,
    received: u64,
}

impl Core for Echo {
    fn handle_frame(&mut self, _now: Timestamp, frame: &[u8]) -> Result<(), SessionError> {
        match frame {
            b"panic" => panic!("expected in this test"),
            b"fail" => Err(SessionError::Peer("x".repeat(500), CloseCode::LimitTooSmall)),
            frame => {
                self.received += 1;
                self.frames.push_back(frame.to_vec());
                Ok(())
            }
        }
    }

    fn poll_transmit(&mut self, _now: Timestamp) -> Result<Option<Vec<u8>>, SessionError> {
        Ok(self.frames.pop_front())
    }

    fn stats(&self) -> SessionStats {
        SessionStats { heap_bytes: 1000 * self.received, ..SessionStats::default() }
    }
}

/// Two models: one to stream, one that is damaged.
struct TestModels;

impl Models for TestModels {
    fn list(&self) -> Vec<ModelEntry> {
        let entry = |id: &str, title: &str, status| ModelEntry {
            id: id.into(),
            title: title.into(),
            triangles: 20,
            vertices: 12,
            bytes: 1000,
            status,
            thumbnail: (id == "echo").then(|| "/models/echo/thumbnail".into()),
            shape: None,
        };
        vec![entry("damaged", "", ModelStatus::Quarantined), entry("echo", "A <b>title", ModelStatus::Ready)]
    }

    fn open_count(&self) -> usize {
        1
    }

    fn open(&self, id: &str) -> Result<Box<dyn Core>, OpenError> {
        match id {
            "echo" => Ok(Box::new(Echo::default())),
            "damaged" => Err(OpenError::Unusable { id: id.into(), reason: "checksum of page 3".into() }),
            _ => Err(OpenError::Unknown(id.into())),
        }
    }

    fn thumbnail(&self, id: &str) -> Result<Option<Vec<u8>>, OpenError> {
        match id {
            "echo" => Ok(Some(b"a picture".to_vec())),
            "bare" => Ok(None),
            _ => self.open(id).map(|_| None),
        }
    }
}

struct Server {
    address: SocketAddr,
    app: Arc<App>,
    serving: JoinHandle<Drained>,
}

type Socket = WebSocketStream<TcpStream>;

impl Server {
    async fn start(change: impl FnOnce(&mut Settings)) -> Self {
        Self::start_with(Viewer::default(), change).await
    }

    async fn start_with(viewer: Viewer, change: impl FnOnce(&mut Settings)) -> Self {
        let mut settings = Settings {
            allowed_origins: vec!["https://friend.example".into()],
            max_connections: 16,
            max_sessions: 4,
            max_session_bytes: 1 << 30,
            resume_for: PATIENCE,
            compute_threads: NonZeroUsize::MIN,
            reader_threads: NonZeroUsize::MIN,
            header_timeout: PATIENCE,
            ping_interval: PATIENCE,
            idle_timeout: PATIENCE,
            write_timeout: PATIENCE,
            close_timeout: Duration::from_millis(200),
            shutdown_deadline: PATIENCE,
            driver: DriverSettings { hello_timeout: PATIENCE, inbound_frames: 8, outbound_frames: 2 },
        };
        change(&mut settings);
        let app = App::new(Box::new(TestModels), viewer, settings, Shutdown::default()).unwrap();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let serving = tokio::spawn(serve(listener, Arc::clone(&app)));
        Self { address, app, serving }
    }

    /// Status and everything after it of the answer to a GET request.
    async fn get(&self, path: &str, headers: &str) -> (u16, String) {
        let (status, head, body) = self.load(path, headers).await;
        (status, format!("{head}{}", String::from_utf8(body).unwrap()).to_lowercase())
    }

    /// Status, the other lines of the head and the body of the answer to a GET request.
    async fn load(&self, path: &str, headers: &str) -> (u16, String, Vec<u8>) {
        let mut socket = TcpStream::connect(self.address).await.unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nhost: {}\r\nconnection: close\r\n{headers}\r\n", self.address);
        socket.write_all(request.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        within(socket.read_to_end(&mut answer)).await.unwrap();
        let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").unwrap() + 4;
        let body = answer.split_off(end);
        let head = String::from_utf8(answer).unwrap();
        let (status, rest) = head.strip_prefix("HTTP/1.1 ").unwrap().split_at(3);
        (status.parse().unwrap(), rest.to_lowercase(), body)
    }

    async fn connect_from(&self, origin: Option<&str>, model: &str) -> Result<Socket, (u16, String)> {
        let mut request = format!("ws://{}/models/{model}/stream", self.address).into_client_request().unwrap();
        if let Some(origin) = origin {
            request.headers_mut().insert("origin", origin.parse().unwrap());
        }
        let stream = TcpStream::connect(self.address).await.unwrap();
        match within(client_async(request, stream)).await {
            Ok((socket, _)) => Ok(socket),
            Err(tungstenite::Error::Http(answer)) => {
                let text = String::from_utf8_lossy(answer.body().as_deref().unwrap_or_default()).into_owned();
                Err((answer.status().as_u16(), text))
            }
            Err(error) => panic!("{error}"),
        }
    }

    async fn connect(&self) -> Socket {
        self.connect_from(None, "echo").await.unwrap()
    }
}

async fn within<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future).await.expect("the server answers in time")
}

async fn say(socket: &mut Socket, frame: &[u8]) {
    within(socket.send(Message::binary(frame.to_vec()))).await.unwrap();
}

/// Code and reason of the close frame, after any number of other frames.
async fn close_frame(socket: &mut Socket) -> (u16, String) {
    loop {
        match within(socket.next()).await {
            Some(Ok(Message::Close(Some(frame)))) => return (frame.code.into(), frame.reason.as_str().into()),
            Some(Ok(_)) => {}
            other => panic!("expected a close frame, got {other:?}"),
        }
    }
}

async fn assert_echoes(socket: &mut Socket) {
    for frame in [&b"hello"[..], b"again"] {
        say(socket, frame).await;
        let answer = loop {
            match within(socket.next()).await.unwrap().unwrap() {
                Message::Ping(_) => {}
                answer => break answer,
            }
        };
        assert_eq!(answer, Message::binary(frame.to_vec()));
    }
}

#[tokio::test]
async fn metrics_count_streams_by_how_they_went() {
    let server = Server::start(|settings| settings.max_sessions = 1).await;
    let mut socket = server.connect().await;
    assert_echoes(&mut socket).await;
    assert_eq!(server.connect_from(None, "echo").await.unwrap_err().0, 503);
    say(&mut socket, b"fail").await;
    assert_eq!(close_frame(&mut socket).await.0, CloseCode::LimitTooSmall as u16);
    drop(socket);
    server.app.admission.wait_empty().await;
    let (status, text) = server.get("/metrics", "").await;
    assert_eq!(status, 200);
    assert!(text.contains("content-type: text/plain; version=0.0.4; charset=utf-8"), "{text}");
    for line in [
        "lodestream_admitted_total 1",
        "lodestream_refused_total{reason=\"full\"} 1",
        "lodestream_closed_total{code=\"limit_too_small\"} 1",
        "lodestream_received_bytes_total 14",
        "lodestream_queue_wait_seconds_bucket{le=\"+inf\"} 10",
        "lodestream_sessions{state=\"moving\"} 0",
        "lodestream_open_models 1",
    ] {
        let name = line.split(' ').next().unwrap();
        let printed = text.lines().find(|line| line.split(' ').next() == Some(name));
        if name.starts_with("lodestream_queue") {
            // Frames in, frames out, and one more when there is nothing left: how many depends on how they meet.
            assert!(printed.is_some_and(|line| !line.ends_with(" 0")), "{name} in\n{text}");
        } else {
            assert_eq!(printed, Some(line));
        }
    }
}

#[tokio::test]
async fn when_sessions_hold_too_much_memory_new_ones_are_refused() {
    // An echo says that it holds 1,000 bytes for each frame that it has received.
    let server = Server::start(|settings| settings.max_session_bytes = 1500).await;
    let mut socket = server.connect().await;
    let mut second = server.connect().await;
    assert_echoes(&mut socket).await;
    let (status, text) = server.connect_from(None, "echo").await.unwrap_err();
    assert_eq!(status, 503);
    assert!(text.contains("memory"), "{text}");
    let (_, metrics) = server.get("/metrics", "").await;
    assert!(metrics.contains("lodestream_refused_total{reason=\"memory\"} 1"), "{metrics}");
    assert_echoes(&mut second).await;
    drop((socket, second));
    server.app.admission.wait_empty().await;
    assert_echoes(&mut server.connect().await).await;
}

#[tokio::test]
async fn health_and_readiness_answer() {
    let server = Server::start(|_| {}).await;
    assert_eq!(server.get("/healthz", "").await.0, 200);
    assert_eq!(server.get("/readyz", "").await.0, 200);
}

#[tokio::test]
async fn models_are_listed_as_json_and_as_a_page() {
    let server = Server::start(|_| {}).await;
    let (status, answer) = server.get("/models", "").await;
    assert_eq!(status, 200);
    let list: serde_json::Value = serde_json::from_str(answer.split("\r\n\r\n").nth(1).unwrap()).unwrap();
    assert_eq!(list[0]["status"], "quarantined");
    assert_eq!((&list[1]["id"], &list[1]["triangles"]), (&"echo".into(), &20.into()));

    let (status, answer) = server.get("/models/echo", "accept: text/html;q=0.5, application/json\r\n").await;
    assert_eq!(status, 200);
    assert!(answer.contains("content-type: application/json") && answer.contains("\"vertices\":12"), "{answer}");

    let (status, answer) = server.get("/models/echo", "").await;
    assert_eq!(status, 200);
    let command = format!("lodestream snapshot http://{}/models/echo --output", server.address);
    assert!(answer.contains(&command) && answer.contains("a &lt;b&gt;title"), "{answer}");
    assert!(answer.contains("built without the viewer") && answer.contains("cargo xtask browser"), "{answer}");

    let (status, answer) = server.get("/", "").await;
    assert!(status == 200 && answer.contains("href=\"models/echo\"") && answer.contains("damaged"), "{answer}");
    assert!(answer.contains("src=\"models/echo/thumbnail\"") && answer.contains("20 triangles, 1 kb"), "{answer}");
}

#[tokio::test]
async fn what_is_not_there_is_said_clearly() {
    let server = Server::start(|_| {}).await;
    let (status, answer) = server.get("/models/none", "accept: application/json\r\n").await;
    assert!(status == 404 && answer.contains("{\"error\":\"there is no model `none`\"}"), "{answer}");
    let (status, answer) = server.get("/models/none", "").await;
    assert!(status == 404 && answer.contains("text/plain") && answer.ends_with("no model `none`\n"), "{answer}");
    assert_eq!(server.get("/nowhere", "").await.0, 404);
    // A page asks like this why its socket was refused.
    assert_eq!(server.get("/models/echo/stream", "").await.0, 426);
    assert_eq!(server.get("/models/none/stream", "").await.0, 404);
    assert_eq!(server.get("/models/damaged/stream", "").await.0, 500);
    assert_eq!(server.get("/viewer/0123/main.js", "").await.0, 404);
    assert_eq!(server.connect_from(None, "none").await.unwrap_err().0, 404);
    let (status, text) = server.connect_from(None, "damaged").await.unwrap_err();
    assert_eq!((status, text.as_str()), (500, "the model `damaged` cannot be used\n"));
    assert_eq!(server.app.admission.active(), 0);
}

#[tokio::test]
async fn streams_carry_frames_both_ways() {
    let server = Server::start(|_| {}).await;
    let mut socket = server.connect().await;
    assert_echoes(&mut socket).await;
    say(&mut socket, &[7; MAX_CLIENT_FRAME_BYTES]).await;
    assert_eq!(within(socket.next()).await.unwrap().unwrap().len(), MAX_CLIENT_FRAME_BYTES);
    within(socket.close(None)).await.unwrap();
    within(server.app.admission.wait_empty()).await;
}

#[tokio::test]
async fn pages_of_other_sites_are_refused() {
    let server = Server::start(|_| {}).await;
    let own = format!("http://{}", server.address);
    assert!(server.connect_from(Some(&own), "echo").await.is_ok());
    assert!(server.connect_from(Some("https://friend.example"), "echo").await.is_ok());
    let (status, text) = server.connect_from(Some("https://foe.example"), "echo").await.unwrap_err();
    assert!(status == 403 && text.contains("foe.example"), "{text}");
}

#[tokio::test]
async fn oversized_and_text_frames_close_the_stream() {
    let server = Server::start(|_| {}).await;
    for len in [MAX_CLIENT_FRAME_BYTES + 1, 1 << 20] {
        let mut socket = server.connect().await;
        let _ = within(socket.send(Message::binary(vec![0; len]))).await;
        let (code, reason) = close_frame(&mut socket).await;
        assert!(code == CloseCode::Malformed as u16 && reason.contains("4096"), "{code} {reason}");
    }
    let mut socket = server.connect().await;
    within(socket.send(Message::text("hello"))).await.unwrap();
    assert_eq!(close_frame(&mut socket).await.0, CloseCode::Malformed as u16);
}

#[tokio::test]
async fn a_frame_that_never_ends_is_not_collected() {
    let server = Server::start(|settings| settings.driver.hello_timeout = Duration::from_millis(100)).await;
    let mut socket = server.connect().await;
    // A masked binary frame of 100 bytes, of which ten come.
    within(socket.get_mut().write_all(&[0x82, 0x80 | 100, 0, 0, 0, 0, 1, 2, 3, 4])).await.unwrap();
    assert_eq!(close_frame(&mut socket).await.0, CloseCode::Timeout as u16);
}

#[tokio::test]
async fn a_client_that_does_not_say_hello_is_closed() {
    let server = Server::start(|settings| settings.driver.hello_timeout = Duration::from_millis(100)).await;
    let mut socket = server.connect().await;
    assert_eq!(close_frame(&mut socket).await, (CloseCode::Timeout as u16, "no hello within 100ms".into()));
}

#[tokio::test]
async fn a_silent_client_is_closed_and_one_that_answers_pings_is_not() {
    let server = Server::start(|settings| {
        settings.ping_interval = Duration::from_millis(100);
        settings.idle_timeout = Duration::from_millis(2000);
    })
    .await;
    let mut silent = server.connect().await;
    say(&mut silent, b"hello").await;
    let mut patient = server.connect().await;
    say(&mut patient, b"hello").await;
    // Reading the bytes as they are answers no ping.
    let mut bytes = Vec::new();
    let is_silent = within(silent.get_mut().read_to_end(&mut bytes));
    let answers_pings = async {
        let mut pings = 0;
        while pings < 25 {
            match within(patient.next()).await.unwrap().unwrap() {
                Message::Ping(_) => pings += 1,
                Message::Binary(_) => {}
                other => panic!("unexpected {other:?}"),
            }
            within(patient.flush()).await.unwrap();
        }
    };
    let (_, ()) = tokio::join!(is_silent, answers_pings);
    let reason = b"nothing received within 2s";
    let code = (CloseCode::Timeout as u16).to_be_bytes();
    assert!(bytes.ends_with(&[&code[..], reason].concat()), "{}", bytes.escape_ascii());
    assert_echoes(&mut patient).await;
}

#[tokio::test]
async fn a_session_that_fails_gives_its_code_and_as_much_of_its_reason_as_fits() {
    let server = Server::start(|_| {}).await;
    let mut socket = server.connect().await;
    say(&mut socket, b"fail").await;
    assert_eq!(close_frame(&mut socket).await, (CloseCode::LimitTooSmall as u16, "x".repeat(123)));
}

#[tokio::test]
async fn a_panic_ends_its_own_session_only() {
    let server = Server::start(|_| {}).await;
    let mut good = server.connect().await;
    assert_echoes(&mut good).await;
    let mut bad = server.connect().await;
    say(&mut bad, b"panic").await;
    assert_eq!(close_frame(&mut bad).await, (CloseCode::Internal as u16, "internal error".into()));
    assert_eq!(server.app.workers.pool.panics(), 1);
    assert_echoes(&mut good).await;
    assert_echoes(&mut server.connect().await).await;
}

#[tokio::test]
async fn a_full_server_refuses_before_the_upgrade_and_has_room_again_later() {
    let server = Server::start(|settings| settings.max_sessions = 1).await;
    let mut first = server.connect().await;
    assert_echoes(&mut first).await;
    let (status, text) = server.connect_from(None, "echo").await.unwrap_err();
    assert!(status == 503 && text.contains("all 1 sessions are in use"), "{text}");
    assert_eq!(server.get("/readyz", "").await.0, 200);
    within(first.close(None)).await.unwrap();
    drop(first);
    within(async { while server.connect_from(None, "echo").await.is_err() {} }).await;
    assert!(server.app.admission.refused() >= 1);
}

#[tokio::test]
async fn connections_over_the_limit_wait_and_slow_heads_are_cut_off() {
    let server = Server::start(|settings| {
        settings.max_connections = 1;
        settings.header_timeout = Duration::from_millis(300);
    })
    .await;
    let mut slow = TcpStream::connect(server.address).await.unwrap();
    slow.write_all(b"GET /healthz HTTP/1.1\r\nhost:").await.unwrap();
    assert_eq!(server.get("/healthz", "").await.0, 200);
    let mut rest = Vec::new();
    let _ = within(slow.read_to_end(&mut rest)).await;
    assert!(!rest.starts_with(b"HTTP/1.1 200"));
}

#[tokio::test]
async fn shutdown_closes_streams_with_going_away_and_then_ends() {
    let server = Server::start(|_| {}).await;
    let mut talking = server.connect().await;
    assert_echoes(&mut talking).await;
    let mut fresh = server.connect().await;
    server.app.shutdown.trigger();
    for socket in [&mut talking, &mut fresh] {
        assert_eq!(close_frame(socket).await, (1001, "the server is shutting down".into()));
    }
    drop((talking, fresh));
    assert_eq!(within(server.serving).await.unwrap(), Drained::Completely);
    assert!(TcpStream::connect(server.address).await.is_err(), "nobody listens any more");
}

#[tokio::test]
async fn shutdown_does_not_wait_for_those_who_do_not_say_goodbye() {
    let server = Server::start(|settings| {
        settings.close_timeout = PATIENCE;
        settings.shutdown_deadline = Duration::from_millis(200);
    })
    .await;
    let mut mute = server.connect().await;
    assert_echoes(&mut mute).await;
    server.app.shutdown.trigger();
    assert_eq!(within(server.serving).await.unwrap(), Drained::Partly { sessions: 1 });
}

#[tokio::test]
async fn thumbnails_have_tags_and_their_absence_is_said() {
    let server = Server::start(|_| {}).await;
    let (status, answer) = server.get("/models/echo/thumbnail", "").await;
    assert_eq!(status, 200);
    assert!(answer.contains("content-type: image/png") && answer.ends_with("\r\n\r\na picture"), "{answer}");
    let tag = answer.lines().find_map(|line| line.strip_prefix("etag: ")).expect("a tag").to_owned();
    let (status, answer) = server.get("/models/echo/thumbnail", &format!("if-none-match: \"x\", {tag}\r\n")).await;
    assert!(status == 304 && !answer.contains("a picture"), "{status} {answer}");
    let (status, _) = server.get("/models/echo/thumbnail", "if-none-match: \"x\"\r\n").await;
    assert_eq!(status, 200);
    let (status, answer) = server.get("/models/bare/thumbnail", "").await;
    assert!(status == 404 && answer.contains("the model `bare` has no thumbnail"), "{answer}");
    let (status, answer) = server.get("/models/nothing/thumbnail", "").await;
    assert!(status == 404 && answer.contains("there is no model `nothing`"), "{answer}");
    assert_eq!(server.get("/models/damaged/thumbnail", "").await.0, 500);
}

#[tokio::test]
async fn pages_go_out_compressed_with_a_tag_for_each_coding() {
    let server = Server::start_with(Viewer::for_tests(), |_| {}).await;
    let value = |head: &str, name: &str| -> Option<String> {
        head.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(": ").map(str::to_owned))
    };
    for path in ["/", "/models/echo", "/models/damaged"] {
        let (status, head, plain) = server.load(path, "accept-encoding: br, gzip;q=0\r\n").await;
        assert_eq!((status, value(&head, "content-encoding")), (200, None), "{path}");
        let (status, head_packed, packed) = server.load(path, "accept-encoding: br, gzip\r\n").await;
        assert_eq!((status, value(&head_packed, "content-encoding").as_deref()), (200, Some("gzip")), "{path}");
        let mut unpacked = Vec::new();
        std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&packed[..]), &mut unpacked).unwrap();
        assert_eq!(unpacked, plain, "{path}");
        assert_eq!(value(&head_packed, "content-length"), Some(packed.len().to_string()));
        let mut tags = Vec::new();
        for (head, coding) in [(&head, "identity"), (&head_packed, "gzip")] {
            assert_eq!(value(head, "content-type").as_deref(), Some("text/html; charset=utf-8"));
            assert_eq!(value(head, "cache-control").as_deref(), Some("no-cache"), "what is kept is asked for again");
            assert_eq!(value(head, "vary").as_deref(), Some("accept, accept-encoding"));
            assert!(value(head, "content-security-policy").unwrap().contains("default-src 'none'"));
            let tag = value(head, "etag").unwrap();
            let again = format!("accept-encoding: {coding}\r\nif-none-match: W/{tag}\r\n");
            let (status, head, body) = server.load(path, &again).await;
            assert!(status == 304 && body.is_empty() && value(&head, "etag").as_ref() == Some(&tag), "{status} {head}");
            tags.push(tag);
        }
        assert_ne!(tags[0], tags[1], "{path}: bytes that differ have tags that differ");
    }
    let (_, answer) = server.get("/models/echo", "").await;
    // Not a picture that says what it shows: the page shows it as it was always shown.
    assert!(answer.contains("<img id=\"poster\" alt=\"\" src=\"data:image/png;base64,"), "{answer}");
}
