//! Who can demonstrate the task: `expert` takes the shortest way, `explore` wanders everywhere.
//!
//! Both read `state`, `goal_state` and `layout` of the infos row and nothing else.

use super::physics::{BORDER, Layout, SIZE};
use super::route::{self, Place};
use rand::Rng as _;
use swm_core::policy::Expert;
use swm_core::{ExpertEntry, Key, Result, Rng, RowRef};

/// The experts of the registry row.
pub const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "the shortest way to the target, through the best door",
        make: || Box::new(Shortest),
    },
    ExpertEntry {
        id: "explore",
        summary: "a smooth random walk through both rooms, the doors and against the walls",
        make: || Box::new(Explorer::new(Key::new(0).rng())),
    },
];

fn place(row: RowRef<'_>, column: &str) -> Result<Place> {
    let value = row.to_f64(column)?;
    Ok([value[0], value[1]])
}

/// Walks straight to the target, or through the door that makes the way shortest.
struct Shortest;

impl Expert for Shortest {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let layout = Layout::from_row(&row.to_f64("layout")?);
        let (at, goal) = (place(row, "state")?, place(row, "goal_state")?);
        let next = route::waypoint(&layout, at, goal);
        let [dx, dy] = [next[0] - at[0], next[1] - at[1]];
        // Full speed, but never past the next turn.
        let divisor = dx.hypot(dy).max(layout.speed);
        action.copy_from_slice(&[dx / divisor, dy / divisor]);
        Ok(())
    }
}

/// Wanders: picks a place anywhere, walks there through the doors, or straight and into the walls, with a pace of
/// its own for each place and slowly changing noise on every step.
struct Explorer {
    rng: Rng,
    /// Where it is heading.
    to: Place,
    /// Whether walls are walked around or into.
    careful: bool,
    /// Length of the action before noise; above 1 its corners are clipped.
    pace: f64,
    /// Steps before it changes its mind.
    patience: u32,
    /// What is added to every action: an autoregressive process.
    noise: [f64; 2],
}

/// Share of places that are walked to through the doors.
const CAREFUL: f64 = 0.7;
/// What is kept of the noise from step to step, and the width of what is added.
const NOISE: (f64, f64) = (0.8, 0.2);

impl Explorer {
    fn new(rng: Rng) -> Self {
        Self { rng, to: [0.0; 2], careful: true, pace: 1.0, patience: 0, noise: [0.0; 2] }
    }

    fn choose(&mut self) {
        self.to = [(); 2].map(|()| self.rng.random_range(BORDER..SIZE - BORDER));
        self.careful = self.rng.random_bool(CAREFUL);
        self.pace = self.rng.random_range(0.4..1.4);
        self.patience = if self.careful { 60 } else { self.rng.random_range(5..25) };
    }
}

impl Expert for Explorer {
    fn begin(&mut self, key: Key) {
        *self = Self::new(key.rng());
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let layout = Layout::from_row(&row.to_f64("layout")?);
        let at = place(row, "state")?;
        let arrived = (self.to[0] - at[0]).hypot(self.to[1] - at[1]) < 2.0 * layout.speed;
        if self.patience == 0 || (arrived && self.careful) {
            self.choose();
        }
        self.patience -= 1;
        let next = if self.careful { route::waypoint(&layout, at, self.to) } else { self.to };
        let [dx, dy] = [next[0] - at[0], next[1] - at[1]];
        let divisor = dx.hypot(dy).max(1e-9);
        for (i, step) in [dx, dy].into_iter().enumerate() {
            let (keep, width) = NOISE;
            self.noise[i] = keep * self.noise[i] + width * self.rng.random_range(-1.0..1.0);
            action[i] = (self.pace * step / divisor + self.noise[i]).clamp(-1.0, 1.0);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trial::{play, reached_of_200};
    use crate::two_room::ENTRY;
    use swm_core::ResetOptions;

    #[test]
    fn the_expert_reaches_the_target() {
        let in_reach = reached_of_200(&ENTRY, 100, 400);
        // Eight of these targets lie deep in the wall, or behind doors too near the border for the agent.
        assert_eq!(in_reach, 192, "everything varied, targets anywhere");
    }

    #[test]
    fn the_explorer_sees_all_of_both_rooms() {
        // The target is kept out of the way, so that episodes last.
        let apart = ResetOptions { goal_state: Some(vec![0.0, 0.0]), ..ResetOptions::default() };
        let mut seen = std::collections::BTreeSet::new();
        let (mut crossings, mut touches) = (0, 0);
        for seed in 0..50 {
            let (places, _) = play(&ENTRY, &EXPERTS[1], seed, &apart, false, 100);
            #[allow(clippy::cast_possible_truncation)]
            seen.extend(places.iter().map(|p| p.map(|v| (v / 16.0) as i64)));
            crossings += places.windows(2).filter(|p| (p[0][0] < 112.0) != (p[1][0] < 112.0)).count();
            touches += places.iter().filter(|p| p[0] == 99.5 || p[0] == 124.5).count();
        }
        // 12 x 12 cells of 16 pixels, less those inside the wall.
        assert!(seen.len() >= 130, "{} cells seen", seen.len());
        assert!(crossings >= 50 && touches >= 100, "{crossings} crossings, {touches} touches of the wall");
    }
}
