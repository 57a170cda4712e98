//! Which error a view leaves after how many ops, asked of the server after a run: the same views again, with tolerances that
//! fall by bands. The link plays no role, nor does the time that it takes.

use std::time::Duration;

use lodestream_protocol::message::{CloseCode, Outcome};
use lodestream_protocol::view::View;
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::LoadOptions;
use super::client::{Failure, chain, session_config};
use super::totals::FIRST_INTERVAL;
use super::trace::{ErrorCurve, Ladder, Trace, TracedView};
use crate::core::ClientSession;
use crate::net::link::LinkShape;
use crate::net::native::{Connection, Event};

/// The server sends by bands, octaves of what ops matter (`order` in the server's session).
const BAND_RATIO: f32 = 2.0;
/// Above every error: a tolerance at which nothing is wanted.
const LARGEST_TOLERANCE_PX: f32 = 1e6;
/// Rungs at most, which span a factor of 2^40.
const MAX_RUNGS: usize = 40;
/// How long all clients together may take.
const TIMEOUT: Duration = Duration::from_secs(120);

/// Error of first and second views, over the clients traced.
#[derive(Debug, Default)]
pub(super) struct ErrorCurves {
    pub(super) first: Option<ErrorCurve>,
    pub(super) second: Option<ErrorCurve>,
    /// Why one is not there, or not of all.
    pub(super) missing: Option<String>,
}

/// Asks for all views that were traced up to their settling, all clients at once.
pub(super) async fn error_curves(options: &LoadOptions, traces: Vec<Trace>) -> ErrorCurves {
    let mut missing = None;
    let mut asked = JoinSet::new();
    let traced = traces.len();
    for trace in traces {
        let views = trace.settled().to_vec();
        if views.is_empty() {
            missing.get_or_insert_with(|| "a first view was replaced before it had settled".to_owned());
            continue;
        }
        let options = options.clone();
        asked.spawn(async move {
            let ladders = timeout(TIMEOUT, ladders(&options, &views)).await;
            (views, ladders)
        });
    }
    let mut all: Vec<(Vec<TracedView>, Vec<Ladder>)> = Vec::new();
    while let Some(ended) = asked.join_next().await {
        match ended {
            Ok((views, Ok(Ok(ladders)))) => all.push((views, ladders)),
            Ok((_, Ok(Err(failure)))) => missing = Some(chain(&failure)),
            Ok((_, Err(_))) => missing = Some(format!("asking again took longer than {} s", TIMEOUT.as_secs())),
            Err(error) => missing = Some(format!("a bug of this program: {error}")),
        }
    }
    let curve = |number: usize| {
        let pairs: Vec<_> =
            all.iter().filter_map(|(views, ladders)| views.get(number).zip(ladders.get(number))).collect();
        ErrorCurve::new(&pairs)
    };
    let (first, second) = (curve(0), curve(1));
    if traced == 0 {
        missing.get_or_insert_with(|| "no client got a stream".into());
    } else if second.is_none() {
        missing.get_or_insert_with(|| "no second view settled".into());
    }
    ErrorCurves { first, second, missing }
}

async fn ladders(options: &LoadOptions, views: &[TracedView]) -> Result<Vec<Ladder>, Failure> {
    let mut connection = Connection::open(&options.target, LinkShape::default()).await?;
    let mut session = ClientSession::new(session_config(options));
    let mut ladders = Vec::new();
    for (number, traced) in views.iter().enumerate() {
        let before = number.checked_sub(1).map(|before| &views[before].view);
        ladders.push(ladder(&mut connection, &mut session, before, &traced.view).await?);
    }
    connection.close(CloseCode::Normal).await;
    Ok(ladders)
}

/// Ops of `view` from the base mesh, or from where the view `before` has settled.
async fn ladder(
    connection: &mut Connection,
    session: &mut ClientSession,
    before: Option<&View>,
    view: &View,
) -> Result<Ladder, Failure> {
    let mut ladder = Ladder::default();
    let mut tolerance_px = LARGEST_TOLERANCE_PX.max(view.tolerance_px);
    let mut from_base = None;
    for _ in 0..MAX_RUNGS {
        // From the base a rung goes on where the one above has ended: what is wanted there is wanted here too. From another
        // view each starts anew, since the rung above has taken back what this one would have found there.
        if let Some(before) = before {
            settle(connection, session, before.clone()).await?;
        }
        let start = ops(session);
        let start = if before.is_some() { start } else { *from_base.get_or_insert(start) };
        let outcome = settle(connection, session, View { tolerance_px, ..view.clone() }).await?;
        ladder.add(ops(session).saturating_sub(start), outcome.error_px);
        if tolerance_px <= view.tolerance_px || outcome.error_px <= 0.0 || outcome.limited {
            break;
        }
        tolerance_px = (outcome.error_px / BAND_RATIO).max(view.tolerance_px);
    }
    Ok(ladder)
}

fn ops(session: &ClientSession) -> u64 {
    session.stats().splits + session.stats().spawns
}

/// Waits until `view` has settled.
async fn settle(connection: &mut Connection, session: &mut ClientSession, view: View) -> Result<Outcome, Failure> {
    session.set_view(connection.now(), view)?;
    loop {
        let now = connection.now();
        while connection.may_send()
            && let Some(frame) = session.poll_transmit(now)
        {
            connection.send(frame);
        }
        if let Some(settled) = session.settled() {
            return Ok(settled.outcome);
        }
        if let Event::Frame(delivery) = connection.next(Some(now + FIRST_INTERVAL)).await? {
            session.handle_frame(connection.now(), &delivery.frame)?;
        }
    }
}
