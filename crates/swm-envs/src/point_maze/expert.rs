//! Who can demonstrate the task: `expert` takes the shortest way, `explore` wanders everywhere.
//!
//! Both read `state`, `goal_state` and `layout` of the infos row and nothing else.

use super::physics::{Layout, MAX_ACTION, SIZE};
use super::route::{Map, Place, Ways};
use rand::Rng as _;
use swm_core::policy::Expert;
use swm_core::{ExpertEntry, Key, Result, Rng, RowRef};

/// The experts of the registry row.
pub const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "the shortest way to the goal, around the walls",
        make: || Box::new(Shortest { guide: None }),
    },
    ExpertEntry {
        id: "explore",
        summary: "a smooth random walk around the walls and into them",
        make: || Box::new(Explorer::new(Key::new(0).rng())),
    },
];

fn place(row: RowRef<'_>, column: &str) -> Result<Place> {
    let value = row.to_f64(column)?;
    Ok([value[0], value[1]])
}

/// Knows the shortest ways to one place in one world.
struct Guide {
    map: Map,
    to: Place,
    ways: Ways,
}

impl Guide {
    /// The guide to a place; what is known already is kept.
    fn to(known: Option<Self>, layout: &Layout, to: Place) -> Self {
        match known {
            Some(guide) if guide.map.layout() == layout && guide.to == to => guide,
            known => {
                let map = known.map(|guide| guide.map).filter(|map| map.layout() == layout);
                let map = map.unwrap_or_else(|| Map::new(layout));
                let ways = map.ways(map.stand(to));
                Self { map, to, ways }
            }
        }
    }

    /// The step, of length 1 along its longer axis at most, from a place; straight where no way is known.
    fn step(&self, from: Place) -> Place {
        let next = self.map.next(from, &self.ways).map_or(self.to, |(next, _)| next);
        step(self.map.layout(), from, next)
    }
}

/// The step towards `next`: as far as the agent gets along a straight line, but never past it.
fn step(layout: &Layout, from: Place, next: Place) -> Place {
    let away = [0, 1].map(|i| next[i] - from[i]);
    let far = f64::from(layout.speed * MAX_ACTION);
    let divisor = away[0].abs().max(away[1].abs()).max(far);
    away.map(|v| v / divisor)
}

/// Walks from turn to turn of the shortest way.
struct Shortest {
    guide: Option<Guide>,
}

impl Expert for Shortest {
    fn begin(&mut self, _key: Key) {
        self.guide = None;
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let layout = Layout::from_row(&row.to_f64("layout")?);
        let guide = Guide::to(self.guide.take(), &layout, place(row, "goal_state")?);
        let step = guide.step(place(row, "state")?);
        action.copy_from_slice(&step.map(|v| v * f64::from(MAX_ACTION)));
        self.guide = Some(guide);
        Ok(())
    }
}

/// Wanders: picks a place anywhere, walks there around the walls, or straight and into them, with a pace of its own
/// for each place and slowly changing noise on every step.
struct Explorer {
    rng: Rng,
    /// Where it is heading.
    to: Place,
    guide: Option<Guide>,
    /// Whether walls are walked around or into.
    careful: bool,
    /// Length of the step before noise; above 1 it is cut.
    pace: f64,
    /// Steps before it changes its mind.
    patience: u32,
    /// What is added to every step: an autoregressive process.
    noise: [f64; 2],
}

/// Share of places that are walked to around the walls.
const CAREFUL: f64 = 0.7;
/// What is kept of the noise from step to step, and the width of what is added.
const NOISE: (f64, f64) = (0.8, 0.2);

impl Explorer {
    fn new(rng: Rng) -> Self {
        Self { rng, to: [0.0; 2], guide: None, careful: false, pace: 1.0, patience: 0, noise: [0.0; 2] }
    }

    fn choose(&mut self) {
        self.to = [(); 2].map(|()| self.rng.random_range(0.0..f64::from(SIZE)));
        self.careful = self.rng.random_bool(CAREFUL);
        self.pace = self.rng.random_range(0.4..1.4);
        self.patience = if self.careful { 40 } else { self.rng.random_range(5..20) };
    }
}

impl Expert for Explorer {
    fn begin(&mut self, key: Key) {
        *self = Self::new(key.rng());
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let layout = Layout::from_row(&row.to_f64("layout")?);
        let at = place(row, "state")?;
        let near = f64::from(2.0 * layout.speed * MAX_ACTION);
        if self.patience == 0 || (self.to[0] - at[0]).hypot(self.to[1] - at[1]) < near {
            self.choose();
        }
        self.patience -= 1;
        let step = if self.careful {
            let guide = Guide::to(self.guide.take(), &layout, self.to);
            self.guide.insert(guide).step(at)
        } else {
            step(&layout, at, self.to)
        };
        for (i, step) in step.into_iter().enumerate() {
            let (keep, width) = NOISE;
            self.noise[i] = keep * self.noise[i] + width * self.rng.random_range(-1.0..1.0);
            action[i] = (self.pace * step + self.noise[i]).clamp(-1.0, 1.0) * f64::from(MAX_ACTION);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::point_maze::ENTRY;
    use crate::trial::{play, reached_of_200};
    use swm_core::ResetOptions;

    #[test]
    fn the_expert_reaches_the_goal() {
        let in_reach = reached_of_200(&ENTRY, 100, 1000);
        // Walls cut the other goals off from all that the agent can walk to.
        assert_eq!(in_reach, 191, "everything varied, goals anywhere");
    }

    #[test]
    fn the_explorer_sees_the_whole_maze() {
        let mut seen = std::collections::BTreeSet::new();
        let mut stopped = 0;
        // The goal is kept out of the way, so that episodes last.
        let apart = ResetOptions { goal_state: Some(vec![0.0, 0.0]), ..ResetOptions::default() };
        for seed in 0..50 {
            let (places, _) = play(&ENTRY, &EXPERTS[1], seed, &apart, false, 100);
            #[allow(clippy::cast_possible_truncation)]
            seen.extend(places.iter().map(|p| p.map(|v| (v * 2.0).min(9.0) as i64)));
            stopped += places.windows(2).filter(|p| p[0] == p[1]).count();
        }
        // 10 x 10 cells of half a unit, less those inside walls.
        assert!(seen.len() >= 80 && stopped >= 100, "{} cells seen, stopped {stopped} times", seen.len());
    }
}
