//! Automatic numbers of triangles: few enough for memory and for the rate of images.

use std::time::Duration;

use lodestream_protocol::time::Timestamp;

/// Images that are looked at together.
const WINDOW: usize = 12;
/// Automatic limits do not fall below this: a picture worth looking at.
const FLOOR: u32 = 30_000;
/// Least time between two changes: the server needs a while to follow, and a limit that flutters would show.
const PAUSE: Duration = Duration::from_millis(800);
/// Longer gaps between images are pauses, not slowness, even in motion: a page in the background draws nothing.
const LONGEST_GAP: Duration = Duration::from_secs(5);
/// Images per second that automatic limits aim at while the camera moves.
pub const AUTO_IMAGES_PER_S: f32 = 30.0;

/// Lowers a limit while images take too long and raises it again when they are quick.
#[derive(Clone, Debug)]
pub struct Governor {
    /// What is held to if images are quick enough.
    most: u32,
    limit: u32,
    gaps: Vec<Duration>,
    /// When the last image was drawn, and whether it was one of a motion.
    last_image: Option<(Timestamp, bool)>,
    changed_at: Option<Timestamp>,
}

impl Governor {
    /// Begins at `most` triangles.
    pub fn new(most: u32) -> Self {
        Self { most, limit: most, gaps: Vec::with_capacity(WINDOW), last_image: None, changed_at: None }
    }

    /// The limit at present.
    pub fn limit(&self) -> u32 {
        self.limit
    }

    /// An image was drawn. `in_motion` says that the next follows at once, so that the time between two such is what one
    /// takes; `triangles` are those drawn.
    pub fn note_image(&mut self, now: Timestamp, in_motion: bool, triangles: u32, wanted_per_s: f32) {
        let last = self.last_image.replace((now, in_motion)).filter(|(_, was_in_motion)| *was_in_motion && in_motion);
        let Some(gap) = last.map(|(at, _)| now.since(at)).filter(|gap| *gap <= LONGEST_GAP) else {
            self.gaps.clear();
            return;
        };
        self.gaps.push(gap);
        if self.gaps.len() < WINDOW {
            return;
        }
        self.gaps.sort_unstable();
        // Neither the fastest nor a single hiccup.
        let typical = self.gaps[WINDOW * 2 / 3].as_secs_f32();
        self.gaps.clear();
        if self.changed_at.is_some_and(|at| now.since(at) < PAUSE) {
            return;
        }
        let wanted = 1.0 / wanted_per_s.max(1.0);
        let floor = FLOOR.min(self.most);
        if typical > 1.3 * wanted {
            let share = (wanted / typical).clamp(0.5, 0.9);
            let held = triangles.min(self.limit);
            self.change(now, ((held as f32 * share) as u32).max(floor).min(self.limit));
        } else if typical < 0.7 * wanted && triangles >= self.limit / 10 * 9 {
            self.change(now, self.limit.saturating_add(self.limit / 4).min(self.most));
        }
    }

    fn change(&mut self, now: Timestamp, limit: u32) {
        if limit != self.limit {
            self.limit = limit;
            self.changed_at = Some(now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Images that take `ns_per_triangle` each, drawn for `seconds` of motion.
    fn run(governor: &mut Governor, from_s: f64, seconds: f64, ns_per_triangle: f64) -> f64 {
        let mut now = from_s;
        while now < from_s + seconds {
            let triangles = governor.limit();
            now += (triangles as f64 * ns_per_triangle * 1e-9).max(1.0 / 60.0);
            governor.note_image(Timestamp(Duration::from_secs_f64(now)), true, triangles, 30.0);
        }
        now
    }

    #[test]
    fn the_limit_follows_what_the_machine_can_do() {
        let mut governor = Governor::new(1_000_000);
        let now = run(&mut governor, 0.0, 20.0, 100.0);
        let slow = governor.limit();
        assert!((200_000..450_000).contains(&slow), "33 ms are 333,333 triangles: {slow}");
        let now = run(&mut governor, now, 30.0, 10.0);
        assert_eq!(governor.limit(), 1_000_000, "and rises again");
        run(&mut governor, now, 300.0, 3_000.0);
        assert_eq!(governor.limit(), FLOOR);
    }

    #[test]
    fn pauses_are_no_slowness() {
        let mut governor = Governor::new(1_000_000);
        for i in 0..1000 {
            governor.note_image(Timestamp(Duration::from_millis(900 * i)), true, 1_000_000, 30.0);
            governor.note_image(Timestamp(Duration::from_millis(900 * i + 300)), false, 1_000_000, 30.0);
        }
        assert_eq!(governor.limit(), 1_000_000);
        assert_eq!(Governor::new(200).limit(), 200, "a small ceiling goes below the floor");
    }
}
