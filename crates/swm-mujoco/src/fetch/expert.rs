//! Scripted experts for the four tasks: stateless controllers that read the columns `proprio` and `desired_goal`.

use super::task::proprio_len;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, RowRef, columns};

macro_rules! expert {
    ($act:ident, $summary:literal) => {
        &[ExpertEntry { id: "expert", summary: $summary, tasks: &[], make: || Box::new(Controller($act)) }]
    };
}

pub const REACH_EXPERTS: &[ExpertEntry] = expert!(reach, "moves the gripper straight to the goal");
pub const PUSH_EXPERTS: &[ExpertEntry] = expert!(push, "moves behind the block and pushes it to the goal");
pub const SLIDE_EXPERTS: &[ExpertEntry] =
    expert!(slide, "moves behind the puck and accelerates it to the speed at which it stops at the goal");
pub const PICK_EXPERTS: &[ExpertEntry] = expert!(pick, "grasps the block from above and carries it to the goal");

type Vec3 = [f64; 3];

/// The quantities that the controllers read.
struct Inputs {
    /// Position of the gripper, in metres.
    gripper: Vec3,
    /// Position of the object's centre, in metres.
    object: Vec3,
    /// Velocity of the object, in metres per action.
    velocity: Vec3,
    /// Distance between the fingers, in metres.
    gap: f64,
    /// The goal, in metres.
    goal: Vec3,
}

/// An expert: a function from inputs to an action.
struct Controller(fn(&Inputs) -> [f64; 4]);

impl Expert for Controller {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let (proprio, goal) = (row.get::<f64>(columns::PROPRIO)?, row.get::<f64>("desired_goal")?);
        let at = |index: usize| [proprio[index], proprio[index + 1], proprio[index + 2]];
        let goal = [goal[0], goal[1], goal[2]];
        let inputs = match proprio.len() {
            n if n == proprio_len(false) => {
                Inputs { gripper: at(0), object: at(0), velocity: [0.0; 3], gap: 0.0, goal }
            }
            n if n == proprio_len(true) => {
                let (relative, gripper) = (at(14), at(20));
                Inputs {
                    gripper: at(0),
                    object: at(3),
                    velocity: std::array::from_fn(|i| relative[i] + gripper[i]),
                    gap: proprio[9] + proprio[10],
                    goal,
                }
            }
            n => {
                let expected = format!("{} or, with an object, {}", proprio_len(false), proprio_len(true));
                return Err(Error::mismatch("controlling a Fetch robot", format!("{n} values in `proprio`"), expected));
            }
        };
        action.copy_from_slice(&(self.0)(&inputs).map(|value| value.clamp(-1.0, 1.0)));
        Ok(())
    }
}

/// Displacement of the gripper for an action of 1, in metres.
const STEP: f64 = 0.05;

/// The action that moves the gripper towards a point, with a command for the fingers.
fn move_to(inputs: &Inputs, target: Vec3, fingers: f64) -> [f64; 4] {
    let displacement = |i: usize| (target[i] - inputs.gripper[i]) / STEP;
    [displacement(0), displacement(1), displacement(2), fingers]
}

fn reach(inputs: &Inputs) -> [f64; 4] {
    move_to(inputs, inputs.goal, 0.0)
}

/// The horizontal direction (unit vector) and distance (m) from one point to another.
fn direction_and_distance(from: Vec3, to: Vec3) -> ([f64; 2], f64) {
    let (x, y) = (to[0] - from[0], to[1] - from[1]);
    let length = x.hypot(y);
    if length < 1e-9 { ([1.0, 0.0], 0.0) } else { ([x / length, y / length], length) }
}

/// The gripper's offset from the object along a horizontal direction, and to the left of this direction, in metres.
fn gripper_offset([x, y]: [f64; 2], inputs: &Inputs) -> (f64, f64) {
    let offset = [inputs.gripper[0] - inputs.object[0], inputs.gripper[1] - inputs.object[1]];
    (offset[0] * x + offset[1] * y, offset[1] * x - offset[0] * y)
}

/// Moves the gripper at the given height (m) to a point `back` metres behind the object's centre. Above the object's
/// height, the gripper can pass over the object. Returns `None` when the gripper is behind the object.
fn move_behind(inputs: &Inputs, direction: [f64; 2], back: f64, height: f64) -> Option<[f64; 4]> {
    let (ahead, left) = gripper_offset(direction, inputs);
    let [x, y] = [0, 1].map(|i| inputs.object[i] - back * direction[i]);
    if ahead < -0.03 && ahead > -back - 0.03 && left.abs() < 0.015 && inputs.gripper[2] < height + 0.02 {
        return None;
    }
    let above = height + 0.08;
    let near = (x - inputs.gripper[0]).hypot(y - inputs.gripper[1]) < 0.02;
    Some(if near {
        move_to(inputs, [x, y, height], 0.0)
    } else if inputs.gripper[2] < above - 0.02 {
        move_to(inputs, [inputs.gripper[0], inputs.gripper[1], above + 0.02], 0.0)
    } else {
        move_to(inputs, [x, y, above], 0.0)
    })
}

fn push(inputs: &Inputs) -> [f64; 4] {
    let (direction, remaining) = direction_and_distance(inputs.object, inputs.goal);
    if remaining < 0.01 {
        return [0.0; 4];
    }
    if let Some(action) = move_behind(inputs, direction, 0.07, 0.425) {
        return action;
    }
    let (_, left) = gripper_offset(direction, inputs);
    let speed = (remaining / STEP).min(1.0);
    let to = [0, 1].map(|i| direction[i] * speed - [-direction[1], direction[0]][i] * 2.0 * left / STEP);
    [to[0], to[1], (0.425 - inputs.gripper[2]) / STEP, 0.0]
}

fn slide(inputs: &Inputs) -> [f64; 4] {
    let (direction, remaining) = direction_and_distance(inputs.object, inputs.goal);
    let speed = inputs.velocity[0].hypot(inputs.velocity[1]);
    // The speed, in metres per action of 0.04 s, from which friction stops the puck at the goal: v² = 2 μ g d.
    let target_speed = (2.0 * 0.1 * 9.81 * remaining).sqrt() * 0.04;
    if speed >= target_speed || remaining < 0.02 {
        let (ahead, _) = gripper_offset(direction, inputs);
        return if ahead > -0.15 { [-direction[0], -direction[1], 0.0, 0.0] } else { [0.0; 4] };
    }
    if speed < 1e-3
        && let Some(action) = move_behind(inputs, direction, 0.07, 0.415)
    {
        return action;
    }
    let (_, left) = gripper_offset(direction, inputs);
    let command = target_speed / STEP;
    let to = [0, 1].map(|i| direction[i] * command - [-direction[1], direction[0]][i] * 2.0 * left / STEP);
    [to[0], to[1], (0.415 - inputs.gripper[2]) / STEP, 0.0]
}

fn pick(inputs: &Inputs) -> [f64; 4] {
    let offset: Vec3 = std::array::from_fn(|i| inputs.object[i] - inputs.gripper[i]);
    let horizontal = offset[0].hypot(offset[1]);
    let (open, shut) = (1.0, -1.0);
    if horizontal < 0.02 && offset[2].abs() < 0.015 {
        // The object is between the fingers, and is grasped when the gap is at most 6 cm.
        return if inputs.gap > 0.06 {
            move_to(inputs, inputs.object, shut)
        } else {
            move_to(inputs, inputs.goal, shut)
        };
    }
    if horizontal < 0.015 {
        return move_to(inputs, inputs.object, open);
    }
    let above = [inputs.object[0], inputs.object[1], inputs.object[2] + 0.08];
    move_to(inputs, above, open)
}

#[cfg(test)]
mod tests {
    use super::super::ENTRIES;
    use swm_core::{Action, Batch, EnvEntry, Key, ResetOptions, Schema, VariationRequest};

    /// Counts the seeds in `0..seeds` for which the goal is reached at the end of the episode.
    fn count_successes(entry: &EnvEntry, seeds: u64, all: bool) -> u32 {
        let vary = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
        let variation = if all { vary } else { VariationRequest::default() };
        let options = ResetOptions { variation, ..ResetOptions::default() };
        let mut env = entry.env().expect("creating the environment");
        let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("creating the schema"), 1);
        let mut count = 0;
        for seed in 0..seeds {
            let mut expert = (entry.experts[0].make)();
            env.reset(seed, &options).expect("resetting the environment");
            expert.begin(Key::new(seed));
            for _ in 0..env.spec().max_episode_steps {
                env.observe(&mut row.row_mut(0));
                let mut action = [0.0; 4];
                expert.act(row.row(0), &mut action).expect("choosing an action");
                env.step(Action::Continuous(&action.map(|a| a as f32))).expect("stepping the environment");
            }
            count += u32::from(env.is_success());
        }
        count
    }

    /// `SEEDS=200 cargo nextest run --release -p swm-mujoco experts --no-capture` prints the table of the README.
    #[test]
    fn experts_reach_expected_success_rates() {
        let seeds: u64 = std::env::var("SEEDS").ok().and_then(|text| text.parse().ok()).unwrap_or(10);
        // Minimum success rates in percent: with default factors, and with all factors varied.
        let minimums = [("Reach", 95, 95), ("Push", 90, 80), ("Slide", 15, 0), ("PickAndPlace", 90, 80)];
        for (entry, (name, default, all)) in ENTRIES.iter().step_by(3).zip(minimums) {
            assert!(entry.id.contains(name));
            let reached = [count_successes(entry, seeds, false), count_successes(entry, seeds, true)];
            #[allow(clippy::print_stderr, reason = "the table of the README")]
            {
                eprintln!("{}: {} of {seeds}, {} with all factors varied", entry.id, reached[0], reached[1]);
            }
            for (reached, minimum) in reached.into_iter().zip([default, all]) {
                assert!(u64::from(reached) * 100 >= minimum * seeds, "{}: {reached} of {seeds}", entry.id);
            }
        }
    }
}
