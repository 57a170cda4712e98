use lodestream_protocol::time::Timestamp;

use super::*;
use crate::session::{SessionError, SessionStats};

const MINUTE: Duration = Duration::from_secs(60);

/// Does nothing and holds a number of bytes.
struct Dummy(u64);

impl Core for Dummy {
    fn handle_frame(&mut self, _: Timestamp, _: &[u8]) -> Result<(), SessionError> {
        Ok(())
    }

    fn poll_transmit(&mut self, _: Timestamp) -> Result<Option<Vec<u8>>, SessionError> {
        Ok(None)
    }

    fn park(&mut self) -> bool {
        true
    }

    fn stats(&self) -> SessionStats {
        SessionStats { heap_bytes: self.0, ..SessionStats::default() }
    }
}

struct Lot {
    parking: Arc<Parking>,
    metrics: Arc<Metrics>,
    start: Instant,
}

impl Lot {
    fn new(limit: u32) -> Self {
        let metrics = Arc::new(Metrics::new());
        Self { parking: Parking::new(MINUTE, limit, metrics.clone()), metrics, start: Instant::now() }
    }

    fn at(&self, seconds: u64) -> Instant {
        self.start + Duration::from_secs(seconds)
    }

    fn open(&self, model: &str) -> Ticket {
        self.parking.open(&model.into(), None).expect("sessions are kept")
    }

    fn kept(&self, bytes: u64) -> Kept {
        let core = Dummy(bytes);
        let mut account = Account::new(self.metrics.clone());
        account.update(core.stats());
        Kept { core: Box::new(core), started: self.start, account }
    }

    /// Parks a session that holds so many bytes, and gives its token.
    fn park(&self, model: &str, bytes: u64, second: u64) -> Token {
        let ticket = self.open(model);
        let token = ticket.token;
        assert!(ticket.park(self.kept(bytes), self.at(second)));
        token
    }

    fn claim(&self, token: Token, model: &str, second: u64) -> Option<Kept> {
        match self.parking.claim(token, model, self.at(second)) {
            Claim::Unknown => None,
            Claim::Parked(kept) => Some(kept),
            Claim::Open(_) => panic!("it is parked, or nowhere"),
        }
    }

    fn count(&self, series: &str) -> u64 {
        let text = self.metrics.render(Default::default());
        let line = text.lines().find_map(|line| line.strip_prefix(series)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("no {series}")).parse().unwrap()
    }

    fn outcomes(&self) -> [u64; 3] {
        ["parked", "expired", "displaced"]
            .map(|outcome| self.count(&format!("lodestream_resumptions_total{{outcome=\"{outcome}\"}}")))
    }
}

#[test]
fn a_token_is_good_once_and_for_its_model() {
    let lot = Lot::new(10);
    let token = lot.park("bunny", 1000, 0);
    let other = lot.park("bunny", 7, 0);
    assert_ne!(token, other);
    assert_eq!(lot.count("lodestream_sessions{state=\"parked\"}"), 2);
    assert_eq!(lot.metrics.session_bytes(), 1007);
    assert!(lot.claim(token, "dragon", 1).is_none(), "a foreign token leads nowhere, and harms nobody");
    let kept = lot.claim(token, "bunny", 1).expect("its client has it back");
    assert_eq!(kept.core.stats().heap_bytes, 1000);
    assert!(lot.claim(token, "bunny", 1).is_none());
    assert_eq!((lot.parking.len(), lot.count("lodestream_sessions{state=\"parked\"}")), (1, 1));
    assert_eq!(lot.count("lodestream_sessions{state=\"moving\"}"), 1);
    drop(kept);
    assert_eq!(lot.metrics.session_bytes(), 7);
    let mut rng = fastrand::Rng::with_seed(1);
    for _ in 0..10_000 {
        // Guesses, and some that are almost right.
        let mut guess = other;
        guess.0[rng.usize(0..16)] ^= 1 << rng.u8(0..8);
        let random = Token(std::array::from_fn(|_| rng.u8(..)));
        assert!(lot.claim(guess, "bunny", 1).is_none() && lot.claim(random, "bunny", 1).is_none());
    }
    assert!(lot.claim(other, "bunny", 1).is_some());
    assert!(lot.parking.lock().tokens.is_empty() && lot.parking.lock().sessions.is_empty());
}

#[test]
fn sessions_go_when_their_time_is_over_and_give_their_memory_back() {
    let lot = Lot::new(10);
    let tokens: Vec<Token> = (0..5).map(|second| lot.park("bunny", 100, second)).collect();
    lot.parking.expire(lot.at(59));
    assert_eq!(lot.metrics.session_bytes(), 500);
    lot.parking.expire(lot.at(61));
    assert_eq!((lot.parking.len(), lot.metrics.session_bytes()), (3, 300));
    assert!(lot.claim(tokens[0], "bunny", 61).is_none());
    assert!(lot.claim(tokens[2], "bunny", 62).is_none(), "too late, though nobody has looked");
    assert!(lot.claim(tokens[3], "bunny", 62).is_some());
    lot.parking.expire(lot.at(1000));
    assert!(lot.parking.is_empty());
    assert_eq!(lot.metrics.session_bytes(), 0);
    assert_eq!(lot.outcomes(), [5, 4, 0]);
    assert!(lot.parking.lock().tokens.is_empty() && lot.parking.lock().sessions.is_empty());
    assert_eq!(lot.count("lodestream_sessions{state=\"parked\"}"), 0);
}

#[test]
fn the_one_parked_first_gives_way() {
    let lot = Lot::new(2);
    let tokens: Vec<Token> = (0..4).map(|second| lot.park("bunny", 10, second)).collect();
    assert_eq!((lot.parking.len(), lot.metrics.session_bytes()), (2, 20));
    assert!(lot.claim(tokens[1], "bunny", 4).is_none());
    assert!(lot.parking.displace());
    assert!(lot.claim(tokens[2], "bunny", 4).is_none());
    assert!(lot.claim(tokens[3], "bunny", 4).is_some());
    assert!(!lot.parking.displace(), "none is left");
    assert_eq!(lot.outcomes(), [4, 0, 3]);
    // A server that stops keeps none.
    lot.park("bunny", 10, 5);
    let open = lot.open("bunny");
    lot.parking.close();
    assert!(lot.parking.is_empty() && lot.parking.open(&"bunny".into(), None).is_none());
    assert!(!open.park(lot.kept(10), lot.at(6)));
    assert_eq!(lot.metrics.session_bytes(), 0);
    // And so does one that is told to.
    assert!(Parking::new(Duration::ZERO, 10, lot.metrics.clone()).open(&"bunny".into(), None).is_none());
}

#[tokio::test]
async fn a_session_with_a_connection_is_handed_over_once() {
    let lot = Lot::new(10);
    let ticket = lot.open("bunny");
    let token = ticket.token;
    assert!(matches!(lot.parking.claim(token, "dragon", lot.start), Claim::Unknown));
    let Claim::Open(session) = lot.parking.claim(token, "bunny", lot.start) else { panic!("it is open") };
    assert!(matches!(lot.parking.claim(token, "bunny", lot.start), Claim::Unknown), "one waits for it already");
    ticket.taken_over().await;
    assert!(ticket.park(lot.kept(5), lot.start));
    assert_eq!(session.await.expect("it is handed over").core.stats().heap_bytes, 5);
    assert!(lot.parking.is_empty() && lot.claim(token, "bunny", 0).is_none());

    // One that waits no more leaves it to be parked.
    let ticket = lot.open("bunny");
    let token = ticket.token;
    drop(lot.parking.claim(token, "bunny", lot.start));
    assert!(ticket.park(lot.kept(6), lot.start));
    assert!(lot.claim(token, "bunny", 1).is_some());

    // One whose session fails is told so.
    let ticket = lot.open("bunny");
    let Claim::Open(session) = lot.parking.claim(ticket.token, "bunny", lot.start) else { panic!("it is open") };
    drop(ticket);
    assert!(session.await.is_err());
    assert!(lot.parking.lock().tokens.is_empty() && lot.parking.lock().sessions.is_empty());
}

#[test]
fn the_token_before_is_good_until_the_newest_is_known() {
    let lot = Lot::new(10);
    let first = lot.park("bunny", 5, 0);
    assert!(lot.claim(first, "bunny", 1).is_some());
    // The answer with the second token is lost.
    let ticket = lot.parking.open(&"bunny".into(), Some(first)).unwrap();
    let second = ticket.token;
    assert!(ticket.park(lot.kept(5), lot.at(2)));
    assert!(lot.claim(first, "bunny", 3).is_some());
    assert!(lot.claim(second, "bunny", 3).is_none(), "the session is out");
    // The third arrives.
    let ticket = lot.parking.open(&"bunny".into(), Some(first)).unwrap();
    let third = ticket.token;
    ticket.confirm();
    assert!(ticket.park(lot.kept(5), lot.at(4)));
    assert!(lot.claim(first, "bunny", 5).is_none());
    assert!(lot.claim(third, "bunny", 5).is_some());
    assert!(lot.parking.lock().tokens.is_empty());
}
