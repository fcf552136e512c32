//! The scripted expert of the acrobot: it plans in equations of motion of its own by model predictive path integral control (Williams
//! et al. 2017, "Information theoretic MPC for model-based reinforcement learning"). The motor is too weak to hold the lower link level, so that no simple
//! rule swings it up in ten seconds.

use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, Rng, RowRef};

/// The experts of the acrobot.
pub const EXPERTS: &[ExpertEntry] = &[ExpertEntry {
    id: "expert",
    summary: "plans swing and balance in equations of motion of its own",
    tasks: &[],
    make: || Box::new(Planner::default()),
}];

/// Duration of an action, in seconds: two control steps.
const ACTION: f64 = 0.02;
/// Actions of a plan: 1.4 s.
const HORIZON: usize = 70;
/// Plans that are compared at each action.
const SAMPLES: usize = 64;
/// Standard deviation of the noise on the actions of a plan, and its correlation from action to action.
const NOISE: f64 = 1.0;
const CORRELATION: f64 = 0.95;
/// Difference of costs at which the weight of a plan falls to 1/e.
const TEMPERATURE: f64 = 0.3;
/// Costs of an action, beside 1 minus the reward: per joule that the energy differs from that at rest at the top, and per squared
/// speed of the elbow, which otherwise keeps the energy by spinning the lower link.
const ENERGY_COST: f64 = 0.05;
const SPIN_COST: f64 = 0.005;
/// The most that a plan's last state costs, and the linear feedback's cost at which it costs half of that.
const END_COST: f64 = 14.0;
const HALF_END_COST: f64 = 1000.0;

/// Linear feedback at the top: the control is the negative product with (shoulder, elbow, their speeds), in radians and rad/s. It minimises the
/// sum of `x1² + x2² + 0.05 (x3² + x4²) + 0.5 u²` over the steps of the linearised motion.
const FEEDBACK: [f64; 4] = [-119.75492, -29.99278, -43.9633, -13.05092];
/// That sum from a state: `x` times this matrix times `x`.
const FEEDBACK_COST: [[f64; 4]; 4] = [
    [95_741.219_4, 27_068.710_8, 35_403.604, 10_978.690],
    [27_068.710_8, 7_694.498_2, 10_013.270_3, 3_109.362_9],
    [35_403.604, 10_013.270_3, 13_093.731_2, 4_060.723],
    [10_978.690, 3_109.362_9, 4_060.723, 1_260.014_9],
];

/// Gravity, in m/s².
const GRAVITY: f64 = 9.81;
/// The distance from a link's joint to its centre of mass, in metres. Links are 1 m long and weigh 1 kg.
const CENTRE: f64 = 0.5;
/// Moment of inertia of a link about its centre of mass, in kg m²: a capsule of 1 m with a radius of 5 cm.
const INERTIA: f64 = 0.095_570_3;
/// Friction of a joint, in N m s, and torque of the control 1, in N m.
const FRICTION: f64 = 0.05;
const TORQUE: f64 = 2.0;
/// Parts of the mass matrix: of the upper link with the lower one at its end, of their coupling, and of the lower link.
const UPPER: f64 = INERTIA + CENTRE * CENTRE + 1.0;
const COUPLING: f64 = CENTRE;
const LOWER: f64 = INERTIA + CENTRE * CENTRE;
/// Potential energy at the top, in J.
const TOP: f64 = GRAVITY * (1.0 + 2.0 * CENTRE);

/// Angles of shoulder and elbow, 0 at the top, in radians, and their speeds, in rad/s.
#[derive(Clone, Copy, Debug, PartialEq)]
struct State {
    angles: [f64; 2],
    speeds: [f64; 2],
}

impl State {
    /// Returns the state after some seconds of these speeds and accelerations.
    fn after(self, seconds: f64, speeds: [f64; 2], accelerations: [f64; 2]) -> Self {
        Self {
            angles: [self.angles[0] + seconds * speeds[0], self.angles[1] + seconds * speeds[1]],
            speeds: [self.speeds[0] + seconds * accelerations[0], self.speeds[1] + seconds * accelerations[1]],
        }
    }

    /// Returns the entries of the symmetric mass matrix: of the shoulder, of both joints, of the elbow.
    fn mass(self) -> [f64; 3] {
        let coupling = COUPLING * self.angles[1].cos();
        [UPPER + LOWER + 2.0 * coupling, LOWER + coupling, LOWER]
    }

    fn accelerations(self, control: f64) -> [f64; 2] {
        let ([shoulder, elbow], [turn, bend]) = (self.angles, self.speeds);
        let inertial = COUPLING * elbow.sin();
        let lower = GRAVITY * CENTRE * (shoulder + elbow).sin();
        let upper = GRAVITY * (1.0 + CENTRE) * shoulder.sin();
        let torques = [
            upper + lower + inertial * (2.0 * turn + bend) * bend - FRICTION * turn,
            lower - inertial * turn * turn - FRICTION * bend + TORQUE * control,
        ];
        let [a, b, d] = self.mass();
        let determinant = a * d - b * b;
        [(d * torques[0] - b * torques[1]) / determinant, (a * torques[1] - b * torques[0]) / determinant]
    }

    /// Returns the state after one action (midpoint method).
    fn next(self, control: f64) -> Self {
        let middle = self.after(ACTION / 2.0, self.speeds, self.accelerations(control));
        self.after(ACTION, middle.speeds, middle.accelerations(control))
    }

    fn energy(self) -> f64 {
        let ([shoulder, elbow], [turn, bend]) = (self.angles, self.speeds);
        let [a, b, d] = self.mass();
        let height = (1.0 + CENTRE) * shoulder.cos() + CENTRE * (shoulder + elbow).cos();
        0.5 * (a * turn * turn + 2.0 * b * turn * bend + d * bend * bend) + GRAVITY * height
    }

    /// Returns the reward of the task `swingup`.
    fn reward(self) -> f64 {
        let ([shoulder, elbow], length) = (self.angles, super::TARGET_RADIUS);
        let across = shoulder.sin() + (shoulder + elbow).sin();
        let below = 2.0 - shoulder.cos() - (shoulder + elbow).cos();
        let outside = (across.hypot(below) - length).max(0.0);
        0.1_f64.powf(outside * outside)
    }

    /// Returns the coordinates of the linear feedback.
    fn coordinates(self) -> [f64; 4] {
        let [shoulder, elbow] = self.angles.map(|angle| (angle + PI).rem_euclid(2.0 * PI) - PI);
        [shoulder, elbow, self.speeds[0], self.speeds[1]]
    }

    fn feedback(self) -> f64 {
        -dot(FEEDBACK, self.coordinates()).clamp(-1.0, 1.0)
    }

    /// Returns the cost of a plan's last state.
    fn end_cost(self) -> f64 {
        let x = self.coordinates();
        let cost = dot(x, FEEDBACK_COST.map(|row| dot(row, x)));
        END_COST * cost / (HALF_END_COST + cost)
    }
}

fn dot(a: [f64; 4], b: [f64; 4]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Improves a plan at every action.
struct Planner {
    rng: Rng,
    /// The plan.
    actions: [f64; HORIZON],
    /// The plans that are compared, and their costs.
    samples: Vec<([f64; HORIZON], f64)>,
}

impl Default for Planner {
    fn default() -> Self {
        Self { rng: Key::new(0).rng(), actions: [0.0; HORIZON], samples: vec![([0.0; HORIZON], 0.0); SAMPLES] }
    }
}

impl Planner {
    /// Draws plans around the last one; the first is the last one itself, and the second follows the linear feedback.
    fn sample(&mut self, start: State) {
        // Uniform noise with a standard deviation of 1.
        let bound = 3.0_f64.sqrt();
        let fresh = (1.0 - CORRELATION * CORRELATION).sqrt();
        for (index, (actions, cost)) in self.samples.iter_mut().enumerate() {
            let (mut state, mut noise) = (start, self.rng.random_range(-bound..bound));
            *cost = 0.0;
            for (action, planned) in actions.iter_mut().zip(self.actions) {
                let wanted = match index {
                    0 => planned,
                    1 => state.feedback(),
                    _ => planned + NOISE * noise,
                };
                *action = wanted.clamp(-1.0, 1.0);
                noise = CORRELATION * noise + fresh * self.rng.random_range(-bound..bound);
                state = state.next(*action);
                *cost +=
                    ENERGY_COST * (state.energy() - TOP).abs() + SPIN_COST * state.speeds[1].powi(2) - state.reward();
            }
            *cost += state.end_cost();
        }
    }

    /// Replaces the plan by the mean of the samples, weighted by their costs.
    fn improve(&mut self) {
        let best = self.samples.iter().map(|(_, cost)| *cost).fold(f64::INFINITY, f64::min);
        let weight = |cost: f64| ((best - cost) / TEMPERATURE).exp();
        let total: f64 = self.samples.iter().map(|(_, cost)| weight(*cost)).sum();
        self.actions = [0.0; HORIZON];
        for (actions, cost) in &self.samples {
            let weight = weight(*cost) / total;
            self.actions.iter_mut().zip(actions).for_each(|(mean, action)| *mean += weight * action);
        }
    }
}

impl Expert for Planner {
    fn begin(&mut self, key: Key) {
        self.rng = key.with("plans").rng();
        self.actions = [0.0; HORIZON];
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let (angles, speeds) = (row.to_f64("qpos")?, row.to_f64("qvel")?);
        let (&[shoulder, elbow], &[turn, bend], [control]) = (&angles[..], &speeds[..], action) else {
            let given = format!("{} angles and {} speeds", angles.len(), speeds.len());
            return Err(Error::mismatch("controlling an acrobot", given, "two of each"));
        };
        self.actions.rotate_left(1);
        self.actions[HORIZON - 1] = 0.0;
        self.sample(State { angles: [shoulder, elbow], speeds: [turn, bend] });
        self.improve();
        *control = self.actions[0];
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TOP_STATE: State = State { angles: [0.0; 2], speeds: [0.0; 2] };

    #[test]
    fn the_motion_without_friction_and_control_keeps_the_energy() {
        let mut state = State { angles: [2.0, 1.0], speeds: [0.5, -1.0] };
        let energy = state.energy();
        for _ in 0..50 {
            // Friction takes what the speeds say.
            let lost = FRICTION * (state.speeds[0].powi(2) + state.speeds[1].powi(2)) * ACTION;
            let next = state.next(0.0);
            assert!((next.energy() - state.energy() + lost).abs() < 0.02, "{} to {}", state.energy(), next.energy());
            state = next;
        }
        assert!(state.energy() < energy);
        assert!((TOP_STATE.energy() - TOP).abs() < 1e-12 && TOP_STATE.reward() == 1.0);
    }

    #[test]
    fn the_feedback_minimises_its_cost() {
        // The cost of a state is that of the step and of the state after the step, at the control of the least sum.
        let cost = |x: [f64; 4]| dot(x, FEEDBACK_COST.map(|row| dot(row, x)));
        for unit in 0..4 {
            let mut x = [0.0; 4];
            x[unit] = 1e-4;
            let state = State { angles: [x[0], x[1]], speeds: [x[2], x[3]] };
            let sum = |control: f64| {
                let step = x[0].powi(2) + x[1].powi(2) + 0.05 * (x[2].powi(2) + x[3].powi(2)) + 0.5 * control * control;
                step + cost(state.next(control).coordinates())
            };
            let control = state.feedback();
            assert!((sum(control) / cost(x) - 1.0).abs() < 1e-2, "{} for {}", sum(control), cost(x));
            let size = control.abs();
            assert!(sum(control) < sum(control - 0.05 * size) && sum(control) < sum(control + 0.05 * size));
        }
    }
}
