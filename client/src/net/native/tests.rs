use futures_util::{SinkExt, StreamExt};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_tungstenite::accept_async;

use super::*;
use crate::net::link::LinkRate;

type ServerSocket = WebSocketStream<Counted<TcpStream>>;

async fn bind() -> (TcpListener, Target) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    (listener, format!("http://{address}/models/bunny").parse().unwrap())
}

/// A server that takes one WebSocket and does `serve` with it.
async fn server<F: Future<Output = T> + Send + 'static, T: Send + 'static>(
    serve: impl FnOnce(ServerSocket) -> F + Send + 'static,
) -> (Target, JoinHandle<T>) {
    let (listener, target) = bind().await;
    let task = tokio::spawn(async move {
        let (stream, _) = listener.accept().await.unwrap();
        serve(accept_async(Counted::new(stream)).await.unwrap()).await
    });
    (target, task)
}

/// A server that reads a request and answers with these bytes.
async fn raw_server(answer: &'static str) -> Target {
    let (listener, target) = bind().await;
    tokio::spawn(async move {
        let (mut stream, _) = listener.accept().await.unwrap();
        let mut request = [0; 4096];
        let read = stream.read(&mut request).await.unwrap();
        assert!(request.starts_with(b"GET /models/bunny/stream HTTP/1.1\r\n"), "{:?}", &request[..read]);
        stream.write_all(answer.as_bytes()).await.unwrap();
        // Lets the client read before the port closes.
        let _ = stream.read(&mut request).await;
    });
    target
}

fn binary(len: usize) -> Message {
    Message::Binary(vec![7; len].into())
}

async fn bounded<T>(future: impl Future<Output = T>) -> T {
    timeout(Duration::from_secs(20), future).await.expect("the test is bounded")
}

async fn frame(connection: &mut Connection) -> Delivery {
    match connection.next(None).await.unwrap() {
        Event::Frame(delivery) => delivery,
        Event::Wake => panic!("no time was given"),
    }
}

async fn opening_fails(target: &Target) -> NetError {
    bounded(Connection::open(target, LinkShape::default())).await.expect_err("must not open")
}

#[tokio::test]
async fn every_byte_is_counted_at_its_place() {
    bounded(async {
        let sizes = [0usize, 125, 126, 0xffff, 0x1_0000, 300_000];
        let (target, task) = server(move |mut socket| async move {
            let mut ends = vec![socket.get_ref().sent()];
            for size in sizes {
                socket.send(Message::Ping(vec![1; 9].into())).await.unwrap();
                socket.send(binary(size)).await.unwrap();
                ends.push(socket.get_ref().sent());
            }
            // The client's frame and its pongs.
            let mut binary = None;
            for _ in 0..=sizes.len() {
                if let Message::Binary(bytes) = socket.next().await.unwrap().unwrap() {
                    binary = Some(bytes);
                }
            }
            assert_eq!(binary.unwrap().as_ref(), [1, 2, 3]);
            (ends, socket.get_ref().received(), socket)
        })
        .await;
        let mut connection = Connection::open(&target, LinkShape::default()).await.unwrap();
        let mut ends = vec![connection.bytes_delivered()];
        connection.send(vec![1, 2, 3]);
        for size in sizes {
            let delivery = frame(&mut connection).await;
            assert_eq!(delivery.frame.len(), size);
            ends.push(delivery.bytes_received);
        }
        // Lets the last pong out.
        let soon = Timestamp(connection.now().0 + Duration::from_millis(50));
        assert!(matches!(connection.next(Some(soon)).await, Ok(Event::Wake)));
        let (sent_ends, server_received, _socket) = task.await.unwrap();
        assert_eq!(ends, sent_ends);
        assert_eq!(connection.bytes_received(), *ends.last().unwrap());
        assert_eq!(connection.bytes_sent(), server_received);
    })
    .await;
}

#[tokio::test]
async fn frames_before_a_close_arrive_and_then_its_reason() {
    bounded(async {
        let (target, _task) = server(|mut socket| async move {
            socket.send(binary(5)).await.unwrap();
            let reason = "the limit must be at least 812\x1b[2J".into();
            socket.close(Some(CloseFrame { code: 4002.into(), reason })).await.unwrap();
            socket
        })
        .await;
        let mut connection = Connection::open(&target, LinkShape::default()).await.unwrap();
        assert_eq!(frame(&mut connection).await.frame, [7; 5]);
        let error = connection.next(None).await.unwrap_err();
        assert!(matches!(error, NetError::Closed { code: 4002, .. }));
        assert_eq!(
            error.to_string(),
            "the server closed the connection: the limit must be at least 812 [2J (LimitTooSmall, code 4002)"
        );
    })
    .await;
}

#[tokio::test]
async fn a_server_that_vanishes_is_reported() {
    bounded(async {
        let (target, _task) = server(|mut socket| async move { socket.send(binary(5)).await.unwrap() }).await;
        let mut connection = Connection::open(&target, LinkShape::default()).await.unwrap();
        assert_eq!(frame(&mut connection).await.frame.len(), 5);
        for _ in 0..3 {
            connection.send(vec![0; 100]);
        }
        let error = connection.next(None).await.unwrap_err();
        assert!(matches!(error, NetError::Lost(_)), "{error:?}");
    })
    .await;
}

#[tokio::test]
async fn overlong_frames_and_text_are_refused_before_they_are_read() {
    bounded(async {
        let (target, _task) = server(|socket| async move {
            let mut stream = socket.into_inner();
            let mut header = vec![0x82, 127];
            header.extend((MAX_FRAME_BYTES as u64 + 1).to_be_bytes());
            stream.write_all(&header).await.unwrap();
            stream
        })
        .await;
        let mut connection = Connection::open(&target, LinkShape::default()).await.unwrap();
        let error = connection.next(None).await.unwrap_err();
        assert!(matches!(error, NetError::BadFrame(_)), "{error:?}");

        let (target, _task) = server(|mut socket| async move {
            socket.send(Message::Text("hello".into())).await.unwrap();
            socket
        })
        .await;
        let mut connection = Connection::open(&target, LinkShape::default()).await.unwrap();
        assert!(matches!(connection.next(None).await, Err(NetError::BadFrame(_))));
    })
    .await;
}

#[tokio::test]
async fn refusals_say_why() {
    let target = raw_server("HTTP/1.1 404 Not Found\r\ncontent-length: 0\r\n\r\n").await;
    assert_eq!(opening_fails(&target).await.to_string(), "no model 'bunny' on this server");

    let target = raw_server("HTTP/1.1 503 Service Unavailable\r\ncontent-length: 8\r\n\r\nis full\n").await;
    assert_eq!(opening_fails(&target).await.to_string(), "the server refused to stream: status 503, is full");

    let target = raw_server("HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n").await;
    assert_eq!(opening_fails(&target).await.to_string(), "the server refused to stream: status 200");

    let target = raw_server("SSH-2.0-OpenSSH_9.2\r\n\r\n").await;
    assert!(matches!(opening_fails(&target).await, NetError::Handshake(_)));

    let (listener, target) = bind().await;
    drop(listener);
    let error = opening_fails(&target).await;
    assert_eq!(error.to_string(), format!("no server answers at {}", target.authority()));
}

#[tokio::test]
async fn a_shaped_link_is_at_least_as_slow_as_asked() {
    bounded(async {
        let (target, _task) = server(|mut socket| async move {
            socket.next().await.unwrap().unwrap();
            socket.send(binary(1000)).await.unwrap();
            socket
        })
        .await;
        let latency = Duration::from_millis(10);
        // 1000 bytes take 20 ms.
        let shape = LinkShape { rate: LinkRate::BitsPerSec(400_000), latency, ..LinkShape::default() };
        let mut connection = Connection::open(&target, shape).await.unwrap();
        assert!(connection.now().0 >= 4 * latency, "TCP and the upgrade take a round trip each");
        connection.send(vec![1]);
        let sent = connection.now();
        let wake = Timestamp(sent.0 + Duration::from_millis(5));
        assert!(matches!(connection.next(Some(wake)).await, Ok(Event::Wake)));
        assert_eq!(frame(&mut connection).await.frame.len(), 1000);
        assert!(connection.now().since(sent) >= 2 * latency + Duration::from_millis(20));
        connection.close(CloseCode::Normal).await;
    })
    .await;
}
