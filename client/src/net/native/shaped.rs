//! A stream behind a [shaped link](crate::net::link): bytes written go out, and bytes read come in, when the link says so.
//!
//! Both directions move whenever either is polled, most of all when it is read: a stream that nobody reads sends nothing
//! that a lane still holds. What does not fit a lane stays in the socket, so the peer feels a slow link as it would a real
//! one.

use std::future::Future;
use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};

use lodestream_protocol::time::Timestamp;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep_until};

use crate::net::link::{Direction, Lane, LinkShape};

/// Most bytes that are read from the socket at once.
const READ_BYTES: usize = 8 << 10;

/// See the module. A transparent shape costs nothing.
#[derive(Debug)]
pub(super) struct Shaped<S> {
    stream: S,
    link: Option<Box<Link>>,
}

#[derive(Debug)]
struct Link {
    start: Instant,
    down: Lane,
    up: Lane,
    /// The socket's end, which comes out after the last byte.
    end: Option<io::Result<()>>,
    /// Wakes the reader and the writer.
    read_timer: Pin<Box<Sleep>>,
    write_timer: Pin<Box<Sleep>>,
}

impl<S> Shaped<S> {
    /// Puts a link before `stream`. Its stalls count from `start`.
    pub(super) fn new(stream: S, shape: &LinkShape, start: Instant) -> Self {
        let link = (!shape.is_transparent()).then(|| {
            Box::new(Link {
                start,
                down: Lane::new(shape, Direction::Down),
                up: Lane::new(shape, Direction::Up),
                end: None,
                read_timer: Box::pin(sleep_until(start)),
                write_timer: Box::pin(sleep_until(start)),
            })
        });
        Self { stream, link }
    }
}

impl Link {
    fn now(&self) -> Timestamp {
        Timestamp(self.start.elapsed())
    }

    /// Moves what the socket brought into the lane, as far as there is room.
    fn fill<S: AsyncRead + Unpin>(&mut self, stream: &mut S, cx: &mut Context<'_>) {
        let mut space = [0; READ_BYTES];
        while self.end.is_none() {
            let now = self.now();
            let room = self.down.room(now).min(READ_BYTES);
            if room == 0 {
                return;
            }
            let mut buf = ReadBuf::new(&mut space[..room]);
            match Pin::new(&mut *stream).poll_read(cx, &mut buf) {
                Poll::Pending => return,
                Poll::Ready(Ok(())) if buf.filled().is_empty() => self.end = Some(Ok(())),
                Poll::Ready(Ok(())) => self.down.push(now, buf.filled()),
                Poll::Ready(Err(error)) => self.end = Some(Err(error)),
            }
        }
    }

    /// Hands the socket what is due, as far as it takes it.
    fn drain<S: AsyncWrite + Unpin>(&mut self, stream: &mut S, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        loop {
            let now = self.now();
            let bytes = self.up.ready(now);
            if bytes.is_empty() {
                return Poll::Ready(Ok(()));
            }
            let count = ready!(Pin::new(&mut *stream).poll_write(cx, bytes))?;
            if count == 0 {
                return Poll::Ready(Err(io::ErrorKind::WriteZero.into()));
            }
            self.up.consume(count);
        }
    }
}

/// Sets the timer to the earliest of these times and says whether it is reached already.
fn is_reached(
    timer: &mut Pin<Box<Sleep>>,
    start: Instant,
    times: impl IntoIterator<Item = Option<Timestamp>>,
    cx: &mut Context<'_>,
) -> bool {
    let Some(next) = times.into_iter().flatten().min() else { return false };
    let deadline = start + next.0;
    if timer.deadline() != deadline {
        timer.as_mut().reset(deadline);
    }
    timer.as_mut().poll(cx).is_ready()
}

impl<S: AsyncRead + AsyncWrite + Unpin> AsyncRead for Shaped<S> {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let Self { stream, link } = self.get_mut();
        let Some(link) = link else { return Pin::new(stream).poll_read(cx, buf) };
        loop {
            // A socket that takes no more will say so when it is read, after what it has brought.
            let is_blocked = !matches!(link.drain(stream, cx), Poll::Ready(Ok(())));
            link.fill(stream, cx);
            let now = link.now();
            let bytes = link.down.ready(now);
            if !bytes.is_empty() || buf.remaining() == 0 {
                let count = bytes.len().min(buf.remaining());
                buf.put_slice(&bytes[..count]);
                link.down.consume(count);
                return Poll::Ready(Ok(()));
            }
            if link.down.is_empty()
                && let Some(end) = link.end.take()
            {
                link.end = Some(Ok(()));
                return Poll::Ready(end);
            }
            let next_room = if link.end.is_none() && link.down.room(now) == 0 { link.down.next_room() } else { None };
            let next_up = if is_blocked { None } else { link.up.next_due() };
            if !is_reached(&mut link.read_timer, link.start, [link.down.next_due(), next_room, next_up], cx) {
                return Poll::Pending;
            }
        }
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Shaped<S> {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let Self { stream, link } = self.get_mut();
        let Some(link) = link else { return Pin::new(stream).poll_write(cx, buf) };
        loop {
            let is_blocked = match link.drain(stream, cx) {
                Poll::Ready(result) => result.map(|()| false)?,
                Poll::Pending => true,
            };
            let now = link.now();
            let count = link.up.room(now).min(buf.len());
            if count > 0 || buf.is_empty() {
                link.up.push(now, &buf[..count]);
                return Poll::Ready(Ok(count));
            }
            let next_up = if is_blocked { None } else { link.up.next_due() };
            if !is_reached(&mut link.write_timer, link.start, [link.up.next_room(), next_up], cx) {
                return Poll::Pending;
            }
        }
    }

    /// What the link holds is as good as sent, like what a socket's buffer holds.
    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let Self { stream, link } = self.get_mut();
        if let Some(link) = link
            && let Poll::Ready(result) = link.drain(stream, cx)
        {
            result?;
        }
        Pin::new(stream).poll_flush(cx)
    }

    /// Waits until all has gone out.
    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let Self { stream, link } = self.get_mut();
        if let Some(link) = link {
            loop {
                ready!(link.drain(stream, cx))?;
                if link.up.is_empty() {
                    break;
                }
                if !is_reached(&mut link.write_timer, link.start, [link.up.next_due()], cx) {
                    return Poll::Pending;
                }
            }
        }
        Pin::new(stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests;
