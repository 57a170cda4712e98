use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::time::{Duration, sleep};

use super::*;
use crate::net::link::LinkRate;

/// Timers of tokio go off at whole milliseconds: what is due in between comes at the next.
const GRAIN: Duration = Duration::from_millis(1);

fn pair(shape: &LinkShape, socket_bytes: usize) -> (Shaped<DuplexStream>, DuplexStream) {
    let (near, far) = duplex(socket_bytes);
    (Shaped::new(near, shape, Instant::now()), far)
}

fn shape(bits_per_sec: u64, latency_ms: u64) -> LinkShape {
    let rate = LinkRate::BitsPerSec(bits_per_sec);
    LinkShape { rate, latency: Duration::from_millis(latency_ms), ..LinkShape::default() }
}

fn pattern(len: usize) -> Vec<u8> {
    (0..len).map(|i| (i * i / 7) as u8).collect()
}

#[tokio::test(start_paused = true)]
async fn a_transfer_takes_what_rate_and_latency_say() {
    for (len, rate, latency) in [(1, 8_000, 50), (100_000, 1_000_000, 50), (3_000_000, 20_000_000, 200)] {
        let (mut near, mut far) = pair(&shape(rate, latency), 1 << 16);
        let sent = pattern(len);
        let start = Instant::now();
        let expected = Duration::from_millis(latency) + Duration::from_secs_f64(len as f64 * 8.0 / rate as f64);
        tokio::spawn({
            let sent = sent.clone();
            async move {
                far.write_all(&sent).await.unwrap();
                // Stays open.
                sleep(Duration::from_secs(1000)).await;
            }
        });
        let mut received = vec![0; len];
        near.read_exact(&mut received).await.unwrap();
        assert!(received == sent, "bytes differ");
        let took = start.elapsed();
        // Each packet's time is rounded down to a nanosecond.
        let rounding = Duration::from_nanos(1 + len as u64 / 1448);
        assert!(took + rounding >= expected && took <= expected + 2 * GRAIN, "{took:?} for {expected:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn what_is_written_takes_as_long_and_goes_out_at_shutdown() {
    let (mut near, mut far) = pair(&shape(1_000_000, 50), 1 << 20);
    let sent = pattern(400_000);
    let start = Instant::now();
    near.write_all(&sent).await.unwrap();
    // All but the buffer of 256 KiB has left the bottleneck by then.
    let left = Duration::from_secs_f64(f64::from(400_000 - (256 << 10)) * 8.0 / 1e6);
    let packet = Duration::from_millis(12);
    let took = start.elapsed();
    assert!(took >= left && took <= left + packet + GRAIN, "{took:?} for {left:?}");
    near.shutdown().await.unwrap();
    let expected = Duration::from_millis(3200 + 50);
    let took = start.elapsed();
    assert!(took + Duration::from_micros(1) >= expected && took <= expected + 2 * GRAIN, "{took:?}");
    let mut received = Vec::new();
    far.read_to_end(&mut received).await.unwrap();
    assert!(received == sent, "bytes differ");
}

#[tokio::test(start_paused = true)]
async fn a_slow_link_makes_the_sender_wait() {
    let socket_bytes = 1 << 14;
    let (mut near, mut far) = pair(&shape(1_000_000, 100), socket_bytes);
    let sender = tokio::spawn(async move {
        let mut taken = 0;
        let bytes = pattern(1000);
        while tokio::time::timeout(Duration::from_millis(500), far.write_all(&bytes)).await.is_ok() {
            taken += bytes.len();
        }
        taken
    });
    // The reader waits for a byte and then takes no more: what moves from here on is what it polled for.
    let mut byte = [0; 1];
    near.read_exact(&mut byte).await.unwrap();
    let taken = sender.await.unwrap();
    let most = (256 << 10) + socket_bytes + 14_500;
    assert!((256 << 10..=most).contains(&taken), "{taken} of at most {most}");
}

#[tokio::test(start_paused = true)]
async fn an_end_comes_after_the_last_byte() {
    let (mut near, mut far) = pair(&shape(8_000, 10), 1 << 10);
    let start = Instant::now();
    far.write_all(&[1; 100]).await.unwrap();
    drop(far);
    let mut received = Vec::new();
    near.read_to_end(&mut received).await.unwrap();
    assert_eq!(received, [1; 100]);
    let took = start.elapsed();
    assert!(took >= Duration::from_millis(110) && took <= Duration::from_millis(112), "{took:?}");
    assert_eq!(near.read(&mut [0; 4]).await.unwrap(), 0, "and stays the end");
}

#[tokio::test(start_paused = true)]
async fn both_directions_move_while_one_is_read() {
    let (mut near, mut far) = pair(&shape(8_000, 100), 1 << 10);
    let start = Instant::now();
    // An echo: 10 bytes there, 20 back.
    tokio::spawn(async move {
        let mut request = [0; 10];
        far.read_exact(&mut request).await.unwrap();
        far.write_all(&[2; 20]).await.unwrap();
        sleep(Duration::from_secs(1000)).await;
    });
    near.write_all(&[1; 10]).await.unwrap();
    near.flush().await.unwrap();
    let mut answer = [0; 20];
    near.read_exact(&mut answer).await.unwrap();
    let took = start.elapsed();
    assert!(took >= Duration::from_millis(230) && took <= Duration::from_millis(233), "{took:?}");
}

#[tokio::test(start_paused = true)]
async fn a_transparent_link_adds_nothing() {
    let (mut near, mut far) = pair(&LinkShape::default(), 1 << 20);
    let start = Instant::now();
    far.write_all(&pattern(500_000)).await.unwrap();
    near.write_all(&[1; 10]).await.unwrap();
    let mut received = vec![0; 500_000];
    near.read_exact(&mut received).await.unwrap();
    far.read_exact(&mut [0; 10]).await.unwrap();
    assert_eq!((start.elapsed(), received == pattern(500_000)), (Duration::ZERO, true));
}
