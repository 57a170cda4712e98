//! Frames: bytes <-> messages. The only file that names bincode.
//!
//! bincode 2.0.1 in its standard configuration (little-endian, variable-length integers). Every decode runs under a byte
//! limit and refuses trailing bytes; no message type is recursive or holds a collection of zero-sized items.

use bincode::config::{Configuration, Limit, LittleEndian, Varint};
use serde::{Serialize, de::DeserializeOwned};

use crate::limits::{MAX_CLIENT_FRAME_BYTES, MAX_FRAME_BYTES};
use crate::message::{ClientMessage, ServerMessage};

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

/// The frame of a server's message.
pub fn encode_server(message: &ServerMessage) -> Vec<u8> {
    encode(message)
}

/// The message of a server's frame.
///
/// # Errors
/// [`WireError`].
pub fn decode_server(bytes: &[u8]) -> Result<ServerMessage, WireError> {
    decode::<_, MAX_FRAME_BYTES>(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::{BatchSeq, ViewSeq};
    use crate::message::{Batch, Hello, Settled};
    use crate::view::View;
    use glam::DVec3;

    fn client_messages() -> Vec<ClientMessage> {
        vec![
            ClientMessage::Hello(Hello {
                version: 1,
                triangle_limit: 5000,
                cache_entries: Some(5000),
                byte_rate: None,
            }),
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
        let settled = Settled { view: ViewSeq(3), seq: BatchSeq(9), error_px: 0.5, limited: true };
        let batch = Batch {
            seq: BatchSeq(1),
            view: ViewSeq(2),
            limit: 1000,
            lambda_px: 1.0,
            digest: 0xdead_beef,
            ops: vec![1, 2, 3],
        };
        for message in [ServerMessage::Batch(batch), ServerMessage::Settled(settled), ServerMessage::Restart] {
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
        let mut huge = vec![1, 1, 1, 253];
        huge.extend([0xff; 8]);
        assert!(decode_server(&huge).is_err());
    }
}
