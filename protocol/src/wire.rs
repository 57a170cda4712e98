//! Frames: bytes <-> messages. The only file that names bincode.
//!
//! bincode 2.0.1 in its standard configuration (little-endian, variable-length integers). Every decode runs under a byte
//! limit and refuses trailing bytes; no message type is recursive or holds a collection of zero-sized items.

use bincode::config::{Configuration, Limit, LittleEndian, Varint};
use serde::{Serialize, de::DeserializeOwned};

use crate::limits::{MAX_CLIENT_FRAME_BYTES, MAX_FRAME_BYTES};
use crate::message::{Batch, ClientMessage, Outcome, ServerMessage};

/// Why a frame was refused: the peer is at fault.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WireError {
    /// Longer than [`limits`](crate::limits) allow.
    #[error("frame of {len} bytes is over the limit of {limit}")]
    TooLong {
        /// Bytes of the frame.
        len: usize,
        /// Bytes allowed.
        limit: usize,
    },
    /// Not a message.
    #[error("malformed frame")]
    Malformed(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// Bytes follow the message.
    #[error("{0} bytes follow the message")]
    Trailing(usize),
}

fn config<const LIMIT: usize>() -> Configuration<LittleEndian, Varint, Limit<LIMIT>> {
    bincode::config::standard().with_limit::<LIMIT>()
}

fn encode(message: &impl Serialize) -> Vec<u8> {
    bincode::serde::encode_to_vec(message, bincode::config::standard()).expect("wire types always encode")
}

fn decode<T: DeserializeOwned, const LIMIT: usize>(bytes: &[u8]) -> Result<T, WireError> {
    if bytes.len() > LIMIT {
        return Err(WireError::TooLong { len: bytes.len(), limit: LIMIT });
    }
    let (message, used) = bincode::serde::decode_from_slice(bytes, config::<LIMIT>())
        .map_err(|error| WireError::Malformed(Box::new(error)))?;
    match bytes.len() - used {
        0 => Ok(message),
        rest => Err(WireError::Trailing(rest)),
    }
}

/// The frame of a client's message.
pub fn encode_client(message: &ClientMessage) -> Vec<u8> {
    encode(message)
}

/// The message of a client's frame.
///
/// # Errors
/// [`WireError`].
pub fn decode_client(bytes: &[u8]) -> Result<ClientMessage, WireError> {
    decode::<_, MAX_CLIENT_FRAME_BYTES>(bytes)
}

/// Frames up to this length are decoded under this limit.
const SHORT_FRAME_BYTES: usize = 1 << 16;
/// Low half of the first byte of a batch's frame: its number among the server's messages. The flags are the upper half.
const BATCH: u8 = 1;
const HAS_LIMIT: u8 = 1 << 4;
const HAS_LAMBDA: u8 = 2 << 4;
const IS_SETTLED: u8 = 4 << 4;
const IS_LIMITED: u8 = 8 << 4;

/// The frame of a server's message. Batches are most of what is sent, so they have a layout of their own.
pub fn encode_server(message: &ServerMessage) -> Vec<u8> {
    match message {
        ServerMessage::Batch(batch) => encode_batch(batch),
        message => encode(message),
    }
}

fn encode_batch(batch: &Batch) -> Vec<u8> {
    let mut out = Vec::with_capacity(batch.ops.len() + 16);
    let flag = |is_set: bool, flag: u8| if is_set { flag } else { 0 };
    let flags = flag(batch.limit.is_some(), HAS_LIMIT)
        | flag(batch.lambda_px.is_some(), HAS_LAMBDA)
        | flag(batch.outcome.is_some(), IS_SETTLED)
        | flag(batch.outcome.is_some_and(|outcome| outcome.limited), IS_LIMITED);
    out.extend([BATCH | flags, batch.seq]);
    out.extend(batch.view.to_le_bytes());
    out.extend(batch.digest.to_le_bytes());
    out.extend(batch.limit.iter().flat_map(|limit| limit.to_le_bytes()));
    out.extend(batch.lambda_px.iter().flat_map(|lambda| lambda.to_le_bytes()));
    let error = batch.outcome.map(|outcome| (outcome.rounded_up().error_px.to_bits() >> 16) as u16);
    out.extend(error.iter().flat_map(|error| error.to_le_bytes()));
    out.extend(&batch.ops);
    out
}

fn decode_batch(bytes: &[u8]) -> Option<Batch> {
    let (&[kind, seq, view_0, view_1, digest_0, digest_1], mut rest) = bytes.split_first_chunk()?;
    let has = |flag: u8| kind & flag != 0;
    if has(IS_LIMITED) && !has(IS_SETTLED) {
        return None;
    }
    let limit = if has(HAS_LIMIT) { Some(u32::from_le_bytes(take(&mut rest)?)) } else { None };
    let lambda_px = if has(HAS_LAMBDA) { Some(f32::from_le_bytes(take(&mut rest)?)) } else { None };
    let error = if has(IS_SETTLED) { Some(u16::from_le_bytes(take(&mut rest)?)) } else { None };
    let outcome = |error: u16| Outcome { error_px: f32::from_bits(u32::from(error) << 16), limited: has(IS_LIMITED) };
    Some(Batch {
        seq,
        view: u16::from_le_bytes([view_0, view_1]),
        digest: u16::from_le_bytes([digest_0, digest_1]),
        limit,
        lambda_px,
        outcome: error.map(outcome),
        ops: rest.to_vec(),
    })
}

/// The next bytes of those that are left.
fn take<const LEN: usize>(rest: &mut &[u8]) -> Option<[u8; LEN]> {
    let (taken, after) = rest.split_first_chunk()?;
    *rest = after;
    Some(*taken)
}

/// The message of a server's frame.
///
/// # Errors
/// [`WireError`].
pub fn decode_server(bytes: &[u8]) -> Result<ServerMessage, WireError> {
    if bytes.first().is_none_or(|first| first & 0xf != BATCH) || bytes.len() > MAX_FRAME_BYTES {
        // A length that is claimed inside a frame allocates before it is found wrong: short frames may not claim much.
        return match bytes.len() {
            0..=SHORT_FRAME_BYTES => decode::<_, SHORT_FRAME_BYTES>(bytes),
            _ => decode::<_, MAX_FRAME_BYTES>(bytes),
        };
    }
    decode_batch(bytes).map(ServerMessage::Batch).ok_or_else(|| WireError::Malformed("a batch's head".into()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::{BatchSeq, Token, ViewSeq};
    use crate::message::{Hello, Resume, Settled};
    use crate::view::View;
    use glam::DVec3;

    fn client_messages() -> Vec<ClientMessage> {
        let hello = Hello { version: 1, triangle_limit: 5000, cache_entries: Some(5000), byte_rate: None };
        let resume = Resume { hello, token: Token([7; 16]), received: None };
        vec![
            ClientMessage::Hello(hello),
            ClientMessage::Resume(resume),
            ClientMessage::Resume(Resume { received: Some(BatchSeq(70_000)), ..resume }),
            ClientMessage::View {
                seq: ViewSeq(7),
                view: View::perspective(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, 0.7),
            },
            ClientMessage::Ack { seq: BatchSeq(300) },
            ClientMessage::Reset { seq: BatchSeq(1) },
        ]
    }

    #[test]
    fn messages_round_trip_and_trailing_bytes_are_refused() {
        for message in client_messages() {
            let mut bytes = encode_client(&message);
            assert_eq!(decode_client(&bytes).unwrap(), message);
            bytes.push(0);
            assert!(matches!(decode_client(&bytes), Err(WireError::Trailing(1))));
            bytes.truncate(bytes.len() - 2);
            assert!(decode_client(&bytes).is_err());
        }
        let outcome = Outcome { error_px: 0.5, limited: true };
        let terse =
            Batch { seq: 1, view: 2, limit: None, lambda_px: None, digest: 77, outcome: None, ops: vec![1, 2, 3] };
        let full =
            Batch { limit: Some(1000), lambda_px: Some(1.0), outcome: Some(outcome), ops: Vec::new(), ..terse.clone() };
        let settled = Settled { view: ViewSeq(3), seq: BatchSeq(9), outcome };
        for message in [
            ServerMessage::Batch(terse),
            ServerMessage::Batch(full),
            ServerMessage::Settled(settled),
            ServerMessage::Restart,
            ServerMessage::Resumed { token: Token([255; 16]) },
        ] {
            assert_eq!(decode_server(&encode_server(&message)).unwrap(), message);
        }
    }

    #[test]
    fn long_and_random_frames_are_refused_without_harm() {
        assert!(matches!(decode_client(&[0; MAX_CLIENT_FRAME_BYTES + 1]), Err(WireError::TooLong { .. })));
        let mut rng = fastrand::Rng::with_seed(5);
        for _ in 0..50_000 {
            let bytes: Vec<u8> = (0..rng.usize(0..80)).map(|_| rng.u8(..)).collect();
            let _ = decode_client(&bytes);
            let _ = decode_server(&bytes);
        }
        // A length near the end of the address space must not allocate.
        let mut huge = vec![0, 253];
        huge.extend([0xff; 8]);
        assert!(decode_server(&huge).is_err());
        // Flags that mean nothing, a head that ends early.
        assert!(decode_server(&[BATCH, 1, 0, 0, 0, 0]).is_ok());
        assert!(decode_server(&[BATCH | IS_LIMITED, 1, 0, 0, 0, 0]).is_err());
        assert!(decode_server(&[BATCH, 1, 0, 0, 0]).is_err());
        assert!(decode_server(&[BATCH | HAS_LIMIT, 1, 0, 0, 0, 0, 5, 0, 0]).is_err());
        assert!(decode_server(&[BATCH | IS_SETTLED, 1, 0, 0, 0, 0, 5]).is_err());
        assert!(decode_server(&[2 | HAS_LIMIT]).is_err());
    }

    #[test]
    fn errors_of_batches_are_rounded_up() {
        let mut rng = fastrand::Rng::with_seed(1);
        let at_random = (0..100_000).map(|_| f32::from_bits(rng.u32(..0x7f80_0000)));
        for error_px in at_random.chain([0.0, f32::MIN_POSITIVE, 1.0, 1.003, f32::MAX, f32::INFINITY]) {
            let exact = Outcome { error_px, limited: true };
            let sent = exact.rounded_up();
            assert!(sent.error_px >= error_px && sent.limited, "{error_px}");
            assert!(
                sent.error_px <= error_px * (1.0 + 1.0 / 128.0) || !(1e-30..1e38).contains(&error_px),
                "{error_px}"
            );
            assert_eq!(sent.rounded_up(), sent);
            let head = Batch { seq: 1, view: 2, limit: None, lambda_px: None, digest: 7, outcome: None, ops: vec![] };
            let [exact, rounded] = [exact, sent].map(|outcome| Batch { outcome: Some(outcome), ..head.clone() });
            let frame = encode_server(&ServerMessage::Batch(exact));
            assert_eq!(frame.len(), 8);
            assert_eq!(decode_server(&frame).unwrap(), ServerMessage::Batch(rounded));
        }
        assert!(Outcome { error_px: f32::NAN, limited: false }.rounded_up().error_px.is_nan());
    }
}
