//! What a session keeps in case its connection breaks, and how it goes on over the next one: the frames that the client has not
//! acknowledged, as they were sent.
//!
//! Whether a client may have the session back is decided elsewhere, by its token. Here its claim of what it holds is checked: a
//! session resumes from any state that the client can be in, and begins anew otherwise.

use std::collections::VecDeque;

use lodestream_protocol::ids::{BatchSeq, Token};
use lodestream_protocol::message::{Resume, ServerMessage};
use lodestream_protocol::time::Timestamp;

use super::{Pacer, Running, Session, SessionError};

/// Batches that were sent and not acknowledged: as many as the window holds, one after the other.
#[derive(Debug, Default)]
pub(super) struct Unacknowledged {
    frames: VecDeque<(BatchSeq, Vec<u8>)>,
    bytes: usize,
    /// From here on they are still to be sent over the new connection.
    next: Option<usize>,
}

impl Unacknowledged {
    pub(super) fn push(&mut self, seq: BatchSeq, frame: Vec<u8>) {
        self.bytes += frame.capacity();
        self.frames.push_back((seq, frame));
    }

    /// Forgets all up to `seq`.
    pub(super) fn acknowledge(&mut self, seq: BatchSeq) {
        while let Some((_, frame)) = self.frames.pop_front_if(|(sent, _)| *sent <= seq) {
            self.bytes -= frame.capacity();
            self.next = self.next.map(|next| next.saturating_sub(1));
        }
    }

    pub(super) fn heap_bytes(&self) -> usize {
        self.bytes + self.frames.capacity() * size_of::<(BatchSeq, Vec<u8>)>()
    }

    /// Whether a client that has received all up to `seq`, where `last` was sent, has all that is not kept here.
    fn continues(&self, seq: BatchSeq, last: BatchSeq) -> bool {
        let kept = u32::try_from(self.frames.len()).unwrap_or(u32::MAX);
        seq <= last && last.0.saturating_sub(kept) <= seq.0
    }

    /// Sends all of them again.
    fn rewind(&mut self) {
        self.next = Some(0);
    }

    /// The next one that is to be sent again.
    pub(super) fn next_again(&mut self) -> Option<(BatchSeq, Vec<u8>)> {
        let next = self.next?;
        let again = self.frames.get(next).cloned();
        self.next = again.is_some().then_some(next + 1);
        again
    }
}

impl Session {
    /// The token that the next answer to a hello carries. From then on the session keeps what the client has not acknowledged.
    pub fn offer(&mut self, token: Token) {
        self.token = Some(token);
    }

    /// The connection broke: rests, and waits for a [`Resume`]. O(ops). Returns whether there is anything to resume: a client that got
    /// no token cannot come back.
    pub fn park(&mut self) -> bool {
        let Some(running) = self.running.as_mut().filter(|running| running.is_resumable) else { return false };
        running.is_parked = true;
        self.control.clear();
        self.rest();
        true
    }

    /// Answers [`Resume`], which comes first on its connection: goes on where the client is, if that can be, and begins anew
    /// otherwise.
    pub(super) fn resume(&mut self, now: Timestamp, claim: &Resume) -> Result<(), SessionError> {
        match &self.running {
            Some(running) if !running.is_parked => return Err(SessionError::malformed("a second hello")),
            Some(running) if running.may_resume(claim) => {}
            _ => {
                self.running = None;
                self.control.clear();
                return self.greet(now, claim.hello);
            }
        }
        let (Some(running), Some(token)) = (&mut self.running, self.token) else {
            return Err(SessionError::Internal("a session resumes without a token".into()));
        };
        self.stats.resumes += 1;
        running.is_parked = false;
        running.is_confirmed = false;
        running.may_repeat_view = true;
        // What was measured is of the connection before, which may have been another network.
        running.pacer = Pacer::new(self.config.max_window_bytes, claim.hello.byte_rate, now);
        self.control.push_back(ServerMessage::Resumed { token });
        match claim.received {
            Some(seq) => {
                running.unacknowledged.acknowledge(seq);
                running.unacknowledged.rewind();
                running.repeats_settled = running.settled_at.is_some();
            }
            None => self.begin_again(now)?,
        }
        Ok(())
    }
}

impl Running {
    fn may_resume(&self, claim: &Resume) -> bool {
        claim.hello.version == lodestream_protocol::message::PROTOCOL_VERSION
            && claim.received.is_none_or(|seq| self.unacknowledged.continues(seq, self.last_seq))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_kept_follows_what_is_acknowledged() {
        let mut kept = Unacknowledged::default();
        assert!(kept.continues(BatchSeq(0), BatchSeq(0)));
        assert!(!kept.continues(BatchSeq(1), BatchSeq(0)), "nothing was sent");
        for seq in 1..=5 {
            kept.push(BatchSeq(seq), vec![seq as u8; 10]);
        }
        assert!(kept.heap_bytes() >= 50);
        kept.acknowledge(BatchSeq(2));
        let last = BatchSeq(5);
        for seq in 0..=6 {
            assert_eq!(kept.continues(BatchSeq(seq), last), (2..=5).contains(&seq), "{seq}");
        }
        assert!(!kept.continues(BatchSeq(u32::MAX), last));
        assert_eq!(kept.next_again(), None, "on the same connection nothing is sent twice");
        kept.rewind();
        assert_eq!(kept.next_again(), Some((BatchSeq(3), vec![3; 10])));
        // An acknowledgement on the way.
        kept.acknowledge(BatchSeq(3));
        kept.push(BatchSeq(6), vec![6; 10]);
        assert_eq!(kept.next_again().map(|sent| sent.0), Some(BatchSeq(4)));
        kept.acknowledge(BatchSeq(5));
        assert_eq!(kept.next_again().map(|sent| sent.0), Some(BatchSeq(6)));
        assert_eq!(kept.next_again(), None);
        kept.push(BatchSeq(7), vec![7; 10]);
        assert_eq!(kept.next_again(), None, "what comes after was sent once");
        kept.acknowledge(BatchSeq(7));
        assert_eq!(kept.bytes, 0);
    }
}
