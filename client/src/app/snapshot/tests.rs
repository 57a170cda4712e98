use std::future::Future;
use std::net::TcpListener;

use futures_util::{SinkExt, StreamExt};
use lodestream_protocol::ids::ViewSeq;
use lodestream_protocol::message::ClientMessage;
use lodestream_protocol::wire::decode_client;
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::CloseFrame;
use tokio_tungstenite::{WebSocketStream, accept_async};

use super::*;
use crate::fake_server::FakeServer;
use crate::net::link::LinkRate;

struct Peer {
    socket: WebSocketStream<TcpStream>,
    server: FakeServer,
}

impl Peer {
    async fn receive(&mut self) -> Option<ClientMessage> {
        match self.socket.next().await?.ok()? {
            Message::Binary(bytes) => Some(decode_client(&bytes).unwrap()),
            _ => None,
        }
    }

    async fn send(&mut self, frame: Vec<u8>) {
        self.socket.send(Message::Binary(frame.into())).await.unwrap();
    }

    /// Says welcome and waits for the view.
    async fn welcome(&mut self) -> ViewSeq {
        assert!(matches!(self.receive().await, Some(ClientMessage::Hello(_))));
        self.send(self.server.welcome()).await;
        match self.receive().await {
            Some(ClientMessage::View { seq, .. }) => seq,
            other => panic!("expected a view, got {other:?}"),
        }
    }

    async fn batches(&mut self, view: ViewSeq, count: usize) {
        for _ in 0..count {
            let batch = self.server.batch(view, 50);
            self.send(batch).await;
        }
    }

    async fn settle(&mut self, view: ViewSeq) {
        self.send(self.server.settled(view)).await;
        while self.receive().await.is_some() {}
    }
}

/// Serves one connection on a thread of its own.
fn serve<F: Future<Output = ()>>(script: impl FnOnce(Peer) -> F + Send + 'static) -> Target {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let target = format!("http://{}/models/tetra", listener.local_addr().unwrap()).parse().unwrap();
    std::thread::spawn(move || {
        let served = native::block_on(async {
            let (stream, _) = listener.accept().unwrap();
            stream.set_nonblocking(true).unwrap();
            let socket = accept_async(TcpStream::from_std(stream).unwrap()).await.unwrap();
            script(Peer { socket, server: FakeServer::new() }).await;
        });
        served.unwrap();
    });
    target
}

fn options(target: Target) -> SnapshotOptions {
    SnapshotOptions {
        target,
        viewport: Viewport { width_px: 320, height_px: 200 },
        pose: None,
        fov_y_rad: 0.8,
        detail: Detail::default(),
        look: Look::default(),
        shape: LinkShape::default(),
        until: Until::Settled,
        reconnect_for: Duration::ZERO,
        output: None,
        export: None,
        stats: None,
    }
}

/// A folder that goes when the test ends.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("lodestream-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn is_empty(&self) -> bool {
        std::fs::read_dir(&self.0).unwrap().count() == 0
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[test]
fn a_settled_snapshot_writes_mesh_and_figures() {
    let target = serve(|mut peer| async move {
        let view = peer.welcome().await;
        peer.batches(view, 6).await;
        peer.settle(view).await;
    });
    let folder = Folder::new("settled");
    let mut options = options(target);
    options.export = Some(folder.0.join("mesh.ply"));
    options.stats = Some(folder.0.join("stats.json"));
    let outcome = run(&options).unwrap();
    assert!(outcome.stats.settled && outcome.stats.batches == 6);

    let figures: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.0.join("stats.json")).unwrap()).unwrap();
    let names = "bytes_received bytes_sent frames splits cached_splits collapses spawns vertices triangles \
                 max_triangles_seen error_px first_image_ms first_image_bytes settled_ms resets";
    for name in names.split_whitespace() {
        assert!(figures[name].is_number(), "{name}: {}", figures[name]);
    }
    assert_eq!(figures["settled"], true);
    assert_eq!(figures["model"], "tetra");
    assert_eq!(figures["frames"], 8);
    assert_eq!(figures["first_image_bytes"], figures["bytes_received"]);
    let ply = std::fs::read(folder.0.join("mesh.ply")).unwrap();
    let faces = format!("element face {}\n", outcome.stats.triangles);
    assert!(ply.windows(faces.len()).any(|bytes| bytes == faces.as_bytes()));
    assert_eq!(std::fs::read_dir(&folder.0).unwrap().count(), 2);
    assert!(outcome.to_string().contains("settled at the triangle limit"));
}

#[test]
fn a_given_pose_goes_out_with_the_hello() {
    let target = serve(|mut peer| async move {
        assert!(matches!(peer.receive().await, Some(ClientMessage::Hello(_))));
        let Some(ClientMessage::View { seq, view }) = peer.receive().await else { panic!("the view comes at once") };
        assert_eq!((view.eye, view.triangle_limit, view.viewport_height_px), ([0.0, 0.0, 9.0], 5000, 200));
        peer.send(peer.server.welcome()).await;
        peer.settle(seq).await;
    });
    let mut options = options(target);
    options.pose = Some((DVec3::new(0.0, 0.0, 9.0), DVec3::ZERO));
    options.detail.triangle_limit = 5000;
    let outcome = run(&options).unwrap();
    assert_eq!((outcome.stats.views, outcome.stats.triangles), (1, 4));
}

#[test]
fn a_byte_limit_is_never_overrun() {
    let script = |mut peer: Peer| async move {
        let view = peer.welcome().await;
        peer.batches(view, 2).await;
        peer.settle(view).await;
    };
    let whole = run(&options(serve(script))).unwrap().stats;
    for (limit, batches, is_settled) in
        [(whole.bytes_received, 2, true), (whole.bytes_received - 1, 2, false), (whole.bytes_received - 30, 1, false)]
    {
        let mut options = options(serve(script));
        options.until = Until::Bytes(limit);
        let stats = run(&options).unwrap().stats;
        assert_eq!((stats.batches, stats.settled), (batches, is_settled));
        assert!(stats.bytes_received <= limit);
    }
    // Not even the welcome fits.
    let folder = Folder::new("nothing");
    let mut options = options(serve(script));
    options.until = Until::Bytes(150);
    options.export = Some(folder.0.join("mesh.ply"));
    assert!(matches!(run(&options), Err(SnapshotError::NoMesh)));
    assert!(folder.is_empty());
}

#[test]
fn time_ends_a_stream_that_does_not_settle() {
    let target = serve(|mut peer| async move {
        let view = peer.welcome().await;
        peer.batches(view, 1).await;
        while peer.receive().await.is_some() {}
    });
    let mut options = options(target);
    options.until = Until::Elapsed(Duration::from_millis(150));
    options.shape =
        LinkShape { rate: LinkRate::BitsPerSec(1_000_000), latency: Duration::from_millis(2), ..LinkShape::default() };
    let outcome = run(&options).unwrap();
    assert!(outcome.elapsed_ms >= 150.0 && !outcome.stats.settled);
    assert_eq!(outcome.stats.batches, 1);
}

#[test]
fn a_server_that_goes_away_leaves_no_files() {
    let folder = Folder::new("gone");
    let target = serve(|mut peer| async move {
        let view = peer.welcome().await;
        peer.batches(view, 1).await;
    });
    let mut lost = options(target);
    lost.export = Some(folder.0.join("mesh.ply"));
    lost.stats = Some(folder.0.join("stats.json"));
    let error = run(&lost).unwrap_err().to_string();
    assert!(error.starts_with("the connection to the server was lost"), "{error}");

    let target = serve(|mut peer| async move {
        peer.receive().await;
        let reason = "the triangle limit must be at least 812".into();
        peer.socket.close(Some(CloseFrame { code: 4002.into(), reason })).await.unwrap();
        while peer.receive().await.is_some() {}
    });
    let error = run(&SnapshotOptions { target, ..lost.clone() }).unwrap_err().to_string();
    assert!(error.contains("the triangle limit must be at least 812 (LimitTooSmall"), "{error}");

    let target = serve(|mut peer| async move {
        peer.receive().await;
        peer.send(vec![250, 1]).await;
        // The client says why it leaves.
        match peer.socket.next().await {
            Some(Ok(Message::Close(Some(frame)))) => assert_eq!(u16::from(frame.code), 4000),
            other => panic!("expected a close frame, got {other:?}"),
        }
    });
    let error = run(&SnapshotOptions { target, ..lost }).unwrap_err().to_string();
    assert_eq!(error, "the server sent a bad frame");
    assert!(folder.is_empty());
}

#[test]
fn unwritable_files_are_noticed_before_streaming() {
    let mut options = options("http://127.0.0.1:1/models/x".parse().unwrap());
    options.export = Some(std::env::temp_dir().join("lodestream-no-such-folder").join("mesh.ply"));
    assert!(matches!(run(&options), Err(SnapshotError::File(_))));
}
