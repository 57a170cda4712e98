//! Connections that break between the real server and a real client: the session goes on for the price of what was lost.

use std::time::Duration;

use futures_util::{SinkExt as _, StreamExt as _};
use glam::DVec3;
use lodestream_client::core::{ClientConfig, ClientSession, Connectivity};
use lodestream_client::net::link::LinkShape;
use lodestream_client::net::native::{Connection, Event};
use lodestream_client::net::target::Target;
use lodestream_protocol::ids::{BatchSeq, Token, ViewSeq};
use lodestream_protocol::message::{ClientMessage, Hello, PROTOCOL_VERSION, Resume, ServerMessage};
use lodestream_protocol::view::{UNLIMITED_TRIANGLES, View};
use lodestream_protocol::wire::{decode_server, encode_client};
use lodestream_tests::meshes;
use lodestream_tests::model::LatticeTriangle;
use lodestream_tests::naive::triangles;
use lodestream_tests::proxy::Proxy;
use lodestream_tests::server_process::{
    ANSWER_LIMIT, RUN_LIMIT, Running, ServerProcess, TempDir, client_bin, described, ingest,
};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{WebSocketStream, client_async};

fn serve(folder: &TempDir) -> ServerProcess {
    let repository = folder.join("repository");
    let meshes = [folder.write_mesh("sphere", &meshes::colored_sphere(6)), folder.write_mesh("cube", &meshes::cube())];
    ingest(&meshes.each_ref().map(|path| &**path), &repository);
    ServerProcess::start(&repository)
}

fn complete_view() -> View {
    let mut view = View::perspective(DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO, 0.8);
    (view.complete, view.triangle_limit, view.tolerance_px) = (true, UNLIMITED_TRIANGLES, 0.0);
    view
}

/// A figure of the server's page of metrics.
fn metric(server: &ServerProcess, series: &str) -> u64 {
    let text = server.get("/metrics");
    let line = text.lines().find_map(|line| line.strip_prefix(series)?.strip_prefix(' '));
    line.unwrap_or_else(|| panic!("no {series} in {text}")).trim().parse().expect("a number")
}

fn outcome(server: &ServerProcess, outcome: &str) -> u64 {
    metric(server, &format!("lodestream_resumptions_total{{outcome=\"{outcome}\"}}"))
}

/// A client with its connection.
struct Client {
    target: Target,
    session: ClientSession,
    connection: Connection,
}

impl Client {
    async fn start(url: &str) -> Self {
        let target: Target = url.parse().expect("an address");
        let connection = Connection::open(&target, LinkShape::default()).await.expect("the server is there");
        let mut session = ClientSession::new(ClientConfig::default());
        session.set_view(connection.now(), complete_view()).expect("a view");
        Self { target, session, connection }
    }

    /// Streams, over as many connections as it takes, until `is_done`.
    async fn run(&mut self, is_done: impl Fn(&ClientSession) -> bool) {
        let Self { target, session, connection } = self;
        let end = connection.now() + RUN_LIMIT;
        while !is_done(session) {
            let now = connection.now();
            assert!(now < end, "it takes too long: {:?}", session.stats());
            while let Some(frame) = session.poll_transmit(now) {
                connection.send(frame);
            }
            match connection.next(Some(end)).await {
                Ok(Event::Wake) => {}
                Ok(Event::Frame(delivery)) => {
                    session.note_traffic(delivery.bytes_received, connection.bytes_sent());
                    session.handle_frame(connection.now(), &delivery.frame).expect("a good frame");
                }
                Err(error) => {
                    assert!(error.is_passing(), "{error}");
                    Self::come_back(target, session, connection).await;
                }
            }
        }
    }

    async fn come_back(target: &Target, session: &mut ClientSession, connection: &mut Connection) {
        loop {
            session.handle_loss(connection.now());
            let Connectivity::Reconnecting { next_try, .. } = session.connectivity() else { panic!("it is lost") };
            connection.sleep_until(next_try).await;
            match connection.reopen(target).await {
                Ok(()) => return,
                Err(error) => assert!(error.is_passing(), "{error}"),
            }
        }
    }

    async fn settle(&mut self) -> u64 {
        self.run(|session| session.settled().is_some()).await;
        self.connection.bytes_received()
    }

    /// The mesh whatever slots it is in, which depend on how it came.
    fn triangles(&self) -> Vec<LatticeTriangle> {
        triangles(self.session.replica().expect("it has settled"))
    }

    fn digest(&self) -> u64 {
        self.session.replica().expect("it has settled").digest()
    }
}

/// Cut at rest: what crosses the link again is two small frames. Cut on the way: the batches that were lost.
#[tokio::test]
async fn a_resumed_session_costs_a_small_share_of_a_fresh_one() {
    let folder = TempDir::new();
    let mut server = serve(&folder);
    let proxy = Proxy::start(server.authority()).await;
    let mut fresh = Client::start(&proxy.url("sphere")).await;
    let whole = fresh.settle().await;
    assert!(whole > 100_000, "{whole}");

    let mut client = Client::start(&proxy.url("sphere")).await;
    let before = client.settle().await;
    let digest = client.digest();
    proxy.cut();
    client.run(|session| session.is_resumed() && session.settled().is_some()).await;
    let extra = client.connection.bytes_received() - before;
    assert!(extra > 0 && extra * 100 < whole, "{extra} bytes of {whole}");
    assert_eq!(client.digest(), digest);
    assert!(client.triangles() == fresh.triangles());
    assert_eq!(client.session.generation(), 1);

    let (mut most, mut lost) = (0, 0);
    for part in 1..6 {
        let mut client = Client::start(&proxy.url("sphere")).await;
        proxy.cut_after(whole * part / 6);
        let total = client.settle().await;
        let stats = client.session.stats();
        assert_eq!((stats.resumed, stats.restarted, stats.resets), (1, 0, 0), "part {part}");
        assert!(client.triangles() == fresh.triangles(), "part {part}");
        most = most.max(total - whole.min(total));
        lost += 1;
    }
    // A window is a quarter of a second at most here; a fresh start would send everything that had come.
    assert!(lost == 5 && most < whole / 3, "{most} bytes more than {whole}");
    assert!(outcome(&server, "resumed") >= 6 && outcome(&server, "refused") == 0);
    server.check_healthy();
}

/// The welcome is one frame with token and base. Whose connection breaks before all of it has come says hello again, and what
/// comes twice is that frame.
#[tokio::test]
async fn a_base_that_breaks_off_comes_anew_and_nothing_else_does() {
    let folder = TempDir::new();
    let mut server = serve(&folder);
    let proxy = Proxy::start(server.authority()).await;
    let mut fresh = Client::start(&proxy.url("sphere")).await;
    fresh.run(|session| session.model().is_some()).await;
    let (bytes, views) = (fresh.connection.bytes_delivered(), fresh.session.stats().views);
    fresh.settle().await;
    // The last byte is missing, half of the frame is (upgrades take 166 bytes), or its head alone has come.
    for cut in [bytes - 1, bytes - (bytes - 166) / 2, 168] {
        assert!(cut > 166 && cut < bytes, "{cut} of {bytes}");
        proxy.cut_after(cut);
        let mut client = Client::start(&proxy.url("sphere")).await;
        client.run(|session| session.model().is_some()).await;
        let delivered = client.connection.bytes_delivered();
        assert!((bytes..=bytes + cut).contains(&delivered), "{delivered} bytes, of which {cut} in vain");
        client.settle().await;
        let stats = client.session.stats();
        assert_eq!((stats.connections_lost, stats.resumed, stats.restarted, stats.resets), (0, 0, 0, 0), "{cut}");
        assert_eq!(stats.views, views + 1, "the view is said again");
        assert!(client.triangles() == fresh.triangles(), "{cut}");
    }
    // Nobody asks for the sessions that were welcomed in vain.
    assert_eq!((outcome(&server, "resumed"), outcome(&server, "refused")), (0, 0));
    server.check_healthy();
}

/// The client notices first: for the server the old connection is as good as ever, and it is closed.
#[tokio::test]
async fn a_half_open_connection_is_taken_over() {
    let folder = TempDir::new();
    let mut server = serve(&folder);
    let proxy = Proxy::start(server.authority()).await;
    let mut client = Client::start(&proxy.url("sphere")).await;
    client.run(|session| session.stats().batches >= 3).await;
    proxy.freeze();
    let Client { target, session, connection } = &mut client;
    Client::come_back(target, session, connection).await;
    client.settle().await;
    assert_eq!((client.session.stats().resumed, client.session.stats().resets), (1, 0));
    server.wait_for_log("goes on over another connection", 1);
    assert_eq!((outcome(&server, "resumed"), outcome(&server, "parked")), (1, 0));
    assert_eq!(metric(&server, "lodestream_closed_total{code=\"taken_over\"}"), 1);
    server.check_healthy();
}

#[tokio::test]
async fn a_server_that_was_started_anew_begins_anew() {
    let folder = TempDir::new();
    let mut server = serve(&folder);
    let proxy = Proxy::start(server.authority()).await;
    let mut client = Client::start(&proxy.url("sphere")).await;
    client.settle().await;
    let (digest, mesh) = (client.digest(), client.triangles());
    server.kill();
    let mut next = ServerProcess::start(&folder.join("repository"));
    proxy.set_target(next.authority());
    client.run(|session| session.stats().restarted == 1).await;
    assert_eq!(client.digest(), digest, "the picture stays");
    client.settle().await;
    assert!(client.triangles() == mesh, "the same mesh in the end");
    let stats = client.session.stats();
    assert_eq!((stats.connections_lost, stats.resumed, stats.restarted, stats.resets), (1, 0, 1, 0));
    assert_eq!(outcome(&next, "refused"), 1);
    next.check_healthy();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_snapshot_survives_a_cut() {
    let folder = TempDir::new();
    let server = serve(&folder);
    let proxy = Proxy::start(server.authority()).await;
    proxy.cut_after(60_000);
    let url = proxy.url("sphere");
    let words = ["snapshot", &url, "--complete", "--triangles", "unlimited", "--json"];
    let client = Running::start(&client_bin(), words);
    let output = tokio::task::spawn_blocking(move || client.wait(RUN_LIMIT)).await.expect("it ends");
    assert!(output.status.success(), "{}", described(&output));
    let stats: serde_json::Value = serde_json::from_slice(&output.stdout).expect("--json prints JSON");
    assert_eq!((&stats["settled"], &stats["resumed"], &stats["resets"]), (&true.into(), &1.into(), &0.into()));
}

type Socket = WebSocketStream<TcpStream>;

async fn connect(server: &ServerProcess, model: &str) -> Socket {
    let stream = TcpStream::connect(server.authority()).await.expect("the server accepts connections");
    let url = format!("ws://{}/models/{model}/stream", server.authority());
    client_async(url, stream).await.expect("the server upgrades").0
}

async fn say(socket: &mut Socket, message: &ClientMessage) {
    socket.send(Message::binary(encode_client(message))).await.expect("the server takes a frame");
}

async fn hear(socket: &mut Socket) -> ServerMessage {
    loop {
        let message = tokio::time::timeout(ANSWER_LIMIT, socket.next()).await.expect("the server answers");
        match message.expect("the server answers").expect("a frame") {
            Message::Binary(bytes) => return decode_server(&bytes).expect("a good frame"),
            Message::Ping(_) => {}
            other => panic!("{other:?}"),
        }
    }
}

fn hello() -> Hello {
    Hello { version: PROTOCOL_VERSION, triangle_limit: UNLIMITED_TRIANGLES, cache_entries: None, byte_rate: None }
}

/// A socket that begins with this claim, and the first answer.
async fn resume(server: &ServerProcess, model: &str, token: Token, received: Option<u32>) -> (Socket, ServerMessage) {
    let mut socket = connect(server, model).await;
    let claim = Resume { hello: hello(), token, received: received.map(BatchSeq) };
    say(&mut socket, &ClientMessage::Resume(claim)).await;
    let answer = hear(&mut socket).await;
    (socket, answer)
}

/// A session of three batches that are not acknowledged, whose connection is open.
async fn open_session(server: &ServerProcess) -> (Socket, Token) {
    let mut socket = connect(server, "sphere").await;
    say(&mut socket, &ClientMessage::Hello(hello())).await;
    let ServerMessage::Welcome { token: Some(token), .. } = hear(&mut socket).await else { panic!("no token") };
    say(&mut socket, &ClientMessage::View { seq: ViewSeq(1), view: complete_view() }).await;
    for _ in 0..3 {
        assert!(matches!(hear(&mut socket).await, ServerMessage::Batch(_)));
    }
    (socket, token)
}

/// The same, cut and parked.
async fn parked_session(server: &ServerProcess) -> Token {
    let before = outcome(server, "parked");
    let (socket, token) = open_session(server).await;
    drop(socket);
    for _ in 0..2000 {
        if outcome(server, "parked") > before {
            return token;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    panic!("the session was not parked");
}

#[tokio::test(flavor = "multi_thread")]
async fn claims_that_are_lies_get_a_fresh_session() {
    let folder = TempDir::new();
    let mut server = serve(&folder);
    let is_fresh = |answer: &ServerMessage| matches!(answer, ServerMessage::Welcome { .. });
    let token = parked_session(&server).await;
    // Guesses.
    let mut rng = fastrand::Rng::with_seed(1);
    for i in 0..20 {
        let mut guess = token;
        match i % 2 {
            0 => guess.0[rng.usize(0..16)] ^= 1 << rng.u8(0..8),
            _ => guess = Token(std::array::from_fn(|_| rng.u8(..))),
        }
        assert!(is_fresh(&resume(&server, "sphere", guess, Some(1)).await.1), "{i}");
    }
    // Another model's, which does the session no harm.
    assert!(is_fresh(&resume(&server, "cube", token, Some(1)).await.1));
    let (mut socket, answer) = resume(&server, "sphere", token, Some(1)).await;
    let ServerMessage::Resumed { token: next } = answer else { panic!("{answer:?}") };
    assert!(matches!(hear(&mut socket).await, ServerMessage::Batch(batch) if batch.seq == 2));
    say(&mut socket, &ClientMessage::Ack { seq: BatchSeq(2) }).await;
    // Twice: the connection has acknowledged, so only the next token counts.
    for seq in 3..=9u8 {
        // More than fit the first window, so the server has heard of the first.
        assert!(matches!(hear(&mut socket).await, ServerMessage::Batch(batch) if batch.seq == seq));
        say(&mut socket, &ClientMessage::Ack { seq: BatchSeq(u32::from(seq)) }).await;
    }
    assert!(is_fresh(&resume(&server, "sphere", token, Some(2)).await.1));
    // While the connection lives: it is closed.
    let (_, answer) = resume(&server, "sphere", next, Some(9)).await;
    assert!(matches!(answer, ServerMessage::Resumed { .. }), "{answer:?}");
    loop {
        match tokio::time::timeout(ANSWER_LIMIT, socket.next()).await.expect("the server says why") {
            Some(Ok(Message::Close(Some(frame)))) => {
                assert_eq!(u16::from(frame.code), 4007);
                break;
            }
            Some(Ok(_)) => {}
            other => panic!("{other:?}"),
        }
    }
    // Numbers that were never sent, and below what was acknowledged.
    for received in [100_000, u32::MAX] {
        let token = parked_session(&server).await;
        assert!(is_fresh(&resume(&server, "sphere", token, Some(received)).await.1), "{received}");
        assert!(is_fresh(&resume(&server, "sphere", token, Some(1)).await.1), "it is gone");
    }
    // All of it again, as the client has nothing of use.
    let token = parked_session(&server).await;
    let (mut socket, answer) = resume(&server, "sphere", token, None).await;
    assert!(matches!(answer, ServerMessage::Resumed { .. }), "{answer:?}");
    assert_eq!(hear(&mut socket).await, ServerMessage::Restart);
    assert!(!server.log().contains(&format!("{:?}", token.0)), "tokens are secrets");
    server.check_healthy();
}
