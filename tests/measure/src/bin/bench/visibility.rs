//! Row 12: how many ops one core judges for a view, with all pages read and checked before.

use anyhow::ensure;
use lodestream_protocol::view::View;
use lodestream_server::pack::PackedModel;
use lodestream_server::session::score::Scorer;
use lodestream_server::session::sweep::Sweep;
use serde_json::json;

use crate::in_process::{processor_time, random_views};
use crate::{Options, Report, Subject, median};

/// What a view asks for: how many ops, and the sum of their numbers, by which two answers are compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Wanted {
    ops: u64,
    sum: u64,
}

impl Wanted {
    #[inline]
    fn add(&mut self, op: u32, is_wanted: bool) {
        self.ops += u64::from(is_wanted);
        self.sum += u64::from(op) * u64::from(is_wanted);
    }
}

/// All ops of the model for each of some random views, twice: page by page along the arrays that a page keeps for this, as a walk
/// over spawns does it, and op by op, as the front looks up what hangs on its rows.
pub(crate) fn measure(subject: &Subject, options: &Options, report: &Report) -> anyhow::Result<()> {
    let model = &subject.test.model;
    let views = random_views(&subject.test, options.views);
    // Once untimed: it reads what is not there yet, and gives what the others are compared with.
    let expected: Vec<Wanted> = views.iter().map(|view| op_by_op(model, view)).collect::<anyhow::Result<_>>()?;
    let tests = f64::from(model.op_count()) * views.len() as f64;
    let wanted: u64 = expected.iter().map(|wanted| wanted.ops).sum();
    type Way = fn(&PackedModel, &View) -> anyhow::Result<Wanted>;
    let ways: [(&str, Way); 2] =
        [("12 node tests, warm, page by page", page_by_page), ("12 node tests, warm, op by op", op_by_op)];
    for (name, way) in ways {
        let mut rates = Vec::new();
        for _ in 0..options.runs {
            let start = processor_time();
            let found: Vec<Wanted> = views.iter().map(|view| way(model, view)).collect::<anyhow::Result<_>>()?;
            rates.push(tests / (processor_time() - start).as_secs_f64() / 1e6);
            ensure!(found == expected, "{name}: other ops are wanted than one by one");
        }
        let more = json!({"ops": model.op_count(), "views": views.len(), "wanted": wanted as f64 / tests, "runs": options.runs});
        report.line(name, &subject.name, median(rates), "M/s", more);
    }
    Ok(())
}

fn op_by_op(model: &PackedModel, view: &View) -> anyhow::Result<Wanted> {
    let scorer = Scorer::new(view, model.info());
    let mut wanted = Wanted::default();
    for op in 0..model.op_count() {
        wanted.add(op, scorer.wants(scorer.priority(&model.bounds(op)?)));
    }
    Ok(wanted)
}

fn page_by_page(model: &PackedModel, view: &View) -> anyhow::Result<Wanted> {
    let scorer = Scorer::new(view, model.info());
    let mut wanted = Wanted::default();
    let mut sweep = Sweep::default();
    for page in 0..model.page_count() {
        let tests = model.tests(page)?;
        let rows = sweep.judge(&scorer, &tests).len();
        for row in 0..rows {
            // What may be wanted or not is judged by itself.
            let is_wanted = scorer.wants(sweep.least()[row])
                || scorer.wants(sweep.most()[row]) && scorer.wants(scorer.priority(&sweep.bounds(&tests, row)));
            wanted.add(tests.first_op + row as u32, is_wanted);
        }
    }
    Ok(wanted)
}
