//! Who can demonstrate the tasks: controllers that read where gripper, object and goal are (`proprio` and `desired_goal`), and
//! remember nothing.

use super::task::known_len;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, RowRef};

macro_rules! expert {
    ($act:ident, $summary:literal) => {
        &[ExpertEntry { id: "expert", summary: $summary, make: || Box::new(Controller($act)) }]
    };
}

pub const REACHERS: &[ExpertEntry] = expert!(reach, "leads the gripper straight to the goal");
pub const PUSHERS: &[ExpertEntry] = expert!(push, "goes behind the block and pushes it to the goal");
pub const SLIDERS: &[ExpertEntry] =
    expert!(slide, "goes behind the puck and pushes it to the speed that ends at the goal");
pub const PICKERS: &[ExpertEntry] = expert!(pick, "grasps the block from above and carries it to the goal");

type Place = [f64; 3];

/// What an expert sees.
struct Sight {
    gripper: Place,
    /// The object's middle, and its velocity in metres per action.
    object: Place,
    velocity: Place,
    /// How wide the fingers are apart, in metres.
    gap: f64,
    goal: Place,
}

/// An expert: a function of what it sees.
struct Controller(fn(&Sight) -> [f64; 4]);

impl Expert for Controller {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let (known, goal) = (row.get::<f64>("proprio")?, row.get::<f64>("desired_goal")?);
        let at = |place: usize| [known[place], known[place + 1], known[place + 2]];
        let sight = match known.len() {
            n if n == known_len(false) => {
                Sight { gripper: at(0), object: at(0), velocity: [0.0; 3], gap: 0.0, goal: [goal[0], goal[1], goal[2]] }
            }
            n if n == known_len(true) => {
                let (relative, gripper) = (at(14), at(20));
                Sight {
                    gripper: at(0),
                    object: at(3),
                    velocity: std::array::from_fn(|i| relative[i] + gripper[i]),
                    gap: known[9] + known[10],
                    goal: [goal[0], goal[1], goal[2]],
                }
            }
            n => return Err(Error::mismatch("acting as Fetch's expert", format!("{n} numbers"), "what Fetch knows")),
        };
        action.copy_from_slice(&(self.0)(&sight).map(|part| part.clamp(-1.0, 1.0)));
        Ok(())
    }
}

/// Metres an action of 1 leads.
const STEP: f64 = 0.05;

/// The action that leads to a place, and what the fingers do.
fn lead(sight: &Sight, to: Place, fingers: f64) -> [f64; 4] {
    let part = |i: usize| (to[i] - sight.gripper[i]) / STEP;
    [part(0), part(1), part(2), fingers]
}

fn reach(sight: &Sight) -> [f64; 4] {
    lead(sight, sight.goal, 0.0)
}

/// The direction and the distance from one place to another, on the table.
fn way(from: Place, to: Place) -> ([f64; 2], f64) {
    let (x, y) = (to[0] - from[0], to[1] - from[1]);
    let length = x.hypot(y);
    if length < 1e-9 { ([1.0, 0.0], 0.0) } else { ([x / length, y / length], length) }
}

/// Where the gripper is, seen from the object along a direction: how far ahead, and how far to its left.
fn seen([x, y]: [f64; 2], sight: &Sight) -> (f64, f64) {
    let away = [sight.gripper[0] - sight.object[0], sight.gripper[1] - sight.object[1]];
    (away[0] * x + away[1] * y, away[1] * x - away[0] * y)
}

/// Goes behind the object, `back` metres from its middle, over it where it is in the way; `None` where it is there.
fn behind(sight: &Sight, direction: [f64; 2], back: f64, height: f64) -> Option<[f64; 4]> {
    let (ahead, left) = seen(direction, sight);
    let [x, y] = [0, 1].map(|i| sight.object[i] - back * direction[i]);
    if ahead < -0.03 && ahead > -back - 0.03 && left.abs() < 0.015 && sight.gripper[2] < height + 0.02 {
        return None;
    }
    let above = height + 0.08;
    let near = (x - sight.gripper[0]).hypot(y - sight.gripper[1]) < 0.02;
    Some(if near {
        lead(sight, [x, y, height], 0.0)
    } else if sight.gripper[2] < above - 0.02 {
        lead(sight, [sight.gripper[0], sight.gripper[1], above + 0.02], 0.0)
    } else {
        lead(sight, [x, y, above], 0.0)
    })
}

fn push(sight: &Sight) -> [f64; 4] {
    let (direction, left) = way(sight.object, sight.goal);
    if left < 0.01 {
        return [0.0; 4];
    }
    if let Some(action) = behind(sight, direction, 0.07, 0.425) {
        return action;
    }
    let (_, aside) = seen(direction, sight);
    let speed = (left / STEP).min(1.0);
    let to = [0, 1].map(|i| direction[i] * speed - [-direction[1], direction[0]][i] * 2.0 * aside / STEP);
    [to[0], to[1], (0.425 - sight.gripper[2]) / STEP, 0.0]
}

fn slide(sight: &Sight) -> [f64; 4] {
    let (direction, left) = way(sight.object, sight.goal);
    let speed = sight.velocity[0].hypot(sight.velocity[1]);
    // Metres per action from which friction stops it there: v² = 2 μ g d, in steps of 0.04 s.
    let wanted = (2.0 * 0.1 * 9.81 * left).sqrt() * 0.04;
    if speed >= wanted || left < 0.02 {
        let (ahead, _) = seen(direction, sight);
        return if ahead > -0.15 { [-direction[0], -direction[1], 0.0, 0.0] } else { [0.0; 4] };
    }
    if speed < 1e-3
        && let Some(action) = behind(sight, direction, 0.07, 0.415)
    {
        return action;
    }
    let (_, aside) = seen(direction, sight);
    let pace = wanted / STEP;
    let to = [0, 1].map(|i| direction[i] * pace - [-direction[1], direction[0]][i] * 2.0 * aside / STEP);
    [to[0], to[1], (0.415 - sight.gripper[2]) / STEP, 0.0]
}

fn pick(sight: &Sight) -> [f64; 4] {
    let away: Place = std::array::from_fn(|i| sight.object[i] - sight.gripper[i]);
    let aside = away[0].hypot(away[1]);
    let (open, shut) = (1.0, -1.0);
    if aside < 0.02 && away[2].abs() < 0.015 {
        // Between the fingers: grasped once these no longer close.
        return if sight.gap > 0.06 { lead(sight, sight.object, shut) } else { lead(sight, sight.goal, shut) };
    }
    if aside < 0.015 {
        return lead(sight, sight.object, open);
    }
    let above = [sight.object[0], sight.object[1], sight.object[2] + 0.08];
    lead(sight, above, open)
}

#[cfg(test)]
mod tests {
    use super::super::ENTRIES;
    use swm_core::{Action, Batch, EnvEntry, Key, ResetOptions, Schema, VariationRequest};

    /// How many of so many seeds the expert solves: those where the goal is reached at the end of the episode.
    fn solved(entry: &EnvEntry, seeds: u64, all: bool) -> u32 {
        let vary = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
        let variation = if all { vary } else { VariationRequest::default() };
        let options = ResetOptions { variation, ..ResetOptions::default() };
        let mut env = entry.env().expect("an environment");
        let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("a schema"), 1);
        let mut count = 0;
        for seed in 0..seeds {
            let mut expert = (entry.experts[0].make)();
            env.reset(seed, &options).expect("a reset");
            expert.begin(Key::new(seed));
            for _ in 0..env.spec().max_episode_steps {
                env.observe(&mut row.row_mut(0));
                let mut action = [0.0; 4];
                expert.act(row.row(0), &mut action).expect("an action");
                env.step(Action::Continuous(&action.map(|a| a as f32))).expect("a step");
            }
            count += u32::from(env.is_success());
        }
        count
    }

    /// `SEEDS=200 cargo nextest run --release -p swm-mujoco experts --no-capture` makes the table of the README.
    #[test]
    fn experts_solve_their_tasks() {
        let seeds: u64 = std::env::var("SEEDS").ok().and_then(|text| text.parse().ok()).unwrap_or(10);
        // Of 100 seeds, with default factors and with all varied; a strike of the puck is a matter of luck, too.
        let least = [("Reach", 95, 95), ("Push", 90, 80), ("Slide", 15, 0), ("PickAndPlace", 90, 80)];
        for (entry, (name, usual, all)) in ENTRIES.iter().step_by(3).zip(least) {
            assert!(entry.id.contains(name));
            let reached = [solved(entry, seeds, false), solved(entry, seeds, true)];
            #[allow(clippy::print_stderr, reason = "the table of the README")]
            {
                eprintln!("{}: {} of {seeds}, {} with all factors varied", entry.id, reached[0], reached[1]);
            }
            for (reached, least) in reached.into_iter().zip([usual, all]) {
                assert!(u64::from(reached) * 100 >= least * seeds, "{}: {reached} of {seeds}", entry.id);
            }
        }
    }
}
