//! Who can demonstrate the task: `expert` makes up for the drift, `explore` wanders everywhere.
//!
//! Both read `state`, `goal_state` and `dynamics` of the infos row and nothing else.

use super::physics::{BORDER, Dynamics, Point, SIZE, distance};
use super::route::{Detour, walk};
use rand::Rng as _;
use swm_core::policy::Expert;
use swm_core::{ExpertEntry, Key, Result, Rng, RowRef};

/// The experts of the registry row.
pub const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "straight to the target, making up for the drift, or around drift that is too strong",
        make: || Box::new(Steersman { plan: None }),
    },
    ExpertEntry {
        id: "explore",
        summary: "a smooth random walk through all zones",
        make: || Box::new(Explorer::new(Key::new(0).rng())),
    },
];

#[allow(clippy::cast_possible_truncation)]
fn place(row: RowRef<'_>, column: &str) -> Result<Point> {
    let value = row.to_f64(column)?;
    Ok([value[0] as f32, value[1] as f32])
}

/// Heads straight for the target where that leads there, and takes a detour where it does not.
struct Steersman {
    plan: Option<Plan>,
}

/// How to get to a target of one world.
struct Plan {
    dynamics: Dynamics,
    to: Point,
    detour: Option<Detour>,
}

impl Expert for Steersman {
    fn begin(&mut self, _key: Key) {
        self.plan = None;
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let dynamics = Dynamics::from_row(&row.to_f64("dynamics")?);
        let (at, to) = (place(row, "state")?, place(row, "goal_state")?);
        let known = self.plan.take().filter(|plan| plan.dynamics == dynamics && plan.to == to);
        let plan = self.plan.insert(known.unwrap_or_else(|| {
            let straight = walk(&dynamics, at, to).1.is_some();
            Plan { dynamics, to, detour: (!straight).then(|| Detour::new(&dynamics, to)) }
        }));
        let next = plan.detour.as_ref().and_then(|detour| detour.next(at)).unwrap_or(to);
        action.copy_from_slice(&dynamics.steer(at, next).map(f64::from));
        Ok(())
    }
}

/// Wanders: picks a place anywhere and heads there for a while, with a pace of its own for each place and slowly
/// changing noise on every step; sometimes it lets itself drift.
struct Explorer {
    rng: Rng,
    /// Where it is heading.
    to: Point,
    /// How much of the way there it wants to go each step; 0 drifts.
    pace: f64,
    /// Steps before it changes its mind.
    patience: u32,
    /// What is added to every action: an autoregressive process.
    noise: [f64; 2],
}

/// Share of the time it drifts.
const DRIFTING: f64 = 0.15;
/// What is kept of the noise from step to step, and the width of what is added.
const NOISE: (f64, f64) = (0.8, 0.2);
/// Nearer than this a place is reached, in pixels.
const NEAR: f32 = 10.0;

impl Explorer {
    fn new(rng: Rng) -> Self {
        Self { rng, to: [0.0; 2], pace: 0.0, patience: 0, noise: [0.0; 2] }
    }

    #[allow(clippy::cast_possible_truncation)]
    fn choose(&mut self) {
        self.to = [(); 2].map(|()| self.rng.random_range(BORDER..SIZE - BORDER) as f32);
        let drifting = self.rng.random_bool(DRIFTING);
        self.pace = if drifting { 0.0 } else { self.rng.random_range(0.4..1.4) };
        self.patience = self.rng.random_range(if drifting { 5..15 } else { 20..50 });
    }
}

impl Expert for Explorer {
    fn begin(&mut self, key: Key) {
        *self = Self::new(key.rng());
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let dynamics = Dynamics::from_row(&row.to_f64("dynamics")?);
        let at = place(row, "state")?;
        if self.patience == 0 || distance(at, self.to) < NEAR {
            self.choose();
        }
        self.patience -= 1;
        let steer = dynamics.steer(at, self.to);
        for (i, steer) in steer.into_iter().enumerate() {
            let (keep, width) = NOISE;
            self.noise[i] = keep * self.noise[i] + width * self.rng.random_range(-1.0..1.0);
            action[i] = (self.pace * f64::from(steer) + self.noise[i]).clamp(-1.0, 1.0);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::piecewise::ENTRY;
    use crate::trial::{play, reached_of_200};
    use swm_core::ResetOptions;

    #[test]
    fn the_expert_reaches_the_target() {
        let in_reach = reached_of_200(&ENTRY, 100, 400);
        // The other targets lie behind drift that is stronger than the agent, or nearly so.
        assert_eq!(in_reach, 190, "everything varied, targets anywhere");
    }

    #[test]
    fn the_explorer_sees_the_whole_room() {
        // The target is kept out of the way, so that episodes last.
        let apart = ResetOptions { goal_state: Some(vec![0.0, 0.0]), ..ResetOptions::default() };
        let mut seen = std::collections::BTreeSet::new();
        for seed in 0..50 {
            let (places, _) = play(&ENTRY, &EXPERTS[1], seed, &apart, false, 100);
            #[allow(clippy::cast_possible_truncation)]
            seen.extend(places.iter().map(|p| p.map(|v| (v / 16.0) as i64)));
        }
        // 12 x 12 cells of 16 pixels.
        assert!(seen.len() >= 130, "{} cells seen", seen.len());
    }
}
