//! The linear-quadratic regulator, a planning problem with a closed-form solution.
//!
//! A force accelerates a cart on a line, `s = (position, speed)`: `s' = A s + B a`. The plan minimises
//! `Σ_t (sᵗᵀ Q sᵗ + R aᵗ²) + sᴴᵀ Q_H sᴴ`. Bellman's recursion (Riccati's equation) gives the best feedback, and the
//! best plan is the sequence of actions of this feedback from the initial state.

use crate::toys::{Landscape, draw};

type State = [f64; 2];
type Matrix = [[f64; 2]; 2];

pub const A: Matrix = [[1.0, 0.5], [0.0, 0.9]];
pub const B: State = [0.1, 0.5];
pub const Q: Matrix = [[1.0, 0.0], [0.0, 0.1]];
pub const LAST: Matrix = [[4.0, 0.0], [0.0, 2.0]];
pub const R: f64 = 1.0;

/// The cart of one environment.
pub struct Lqr {
    start: State,
}

impl Lqr {
    pub const HORIZON: usize = 6;

    pub fn new(env: usize) -> Self {
        let start = draw(env, 2, 1.5);
        Self { start: [start[0], start[1]] }
    }

    /// The states of a plan, the initial one included.
    fn states(&self, plan: &[f64]) -> Vec<State> {
        let mut states = vec![self.start];
        for (t, a) in plan.iter().enumerate() {
            let s = states[t];
            states.push([0, 1].map(|i| dot(A[i], s) + B[i] * a));
        }
        states
    }
}

impl Landscape for Lqr {
    fn cost(&self, plan: &[f64]) -> f64 {
        let states = self.states(plan);
        let running: f64 = plan.iter().zip(&states).map(|(a, &s)| dot(s, times(Q, s)) + R * a * a).sum();
        let last = states[plan.len()];
        running + dot(last, times(LAST, last))
    }

    fn gradient(&self, plan: &[f64]) -> Vec<f64> {
        // The adjoint p_t = ∂cost/∂s_t, computed backwards.
        let states = self.states(plan);
        let mut gradient = vec![0.0; plan.len()];
        let mut p = times(LAST, states[plan.len()]).map(|v| 2.0 * v);
        for t in (0..plan.len()).rev() {
            gradient[t] = 2.0 * R * plan[t] + dot(B, p);
            let (back, here) = (times(transpose(A), p), times(Q, states[t]));
            p = [0, 1].map(|i| back[i] + 2.0 * here[i]);
        }
        gradient
    }

    fn optimum(&self) -> Vec<f64> {
        // P_t is the cost to go: K = (R + BᵀPB)⁻¹ BᵀPA and P ← Q + AᵀP(A - BK), from the end to the start.
        let mut value = LAST;
        let mut gains = vec![];
        for _ in 0..Self::HORIZON {
            let push = times(value, B);
            let gain = times(transpose(A), push).map(|v| v / (R + dot(B, push)));
            let closed: Matrix = [0, 1].map(|i| [0, 1].map(|j| A[i][j] - B[i] * gain[j]));
            let next = product(transpose(A), product(value, closed));
            value = [0, 1].map(|i| [0, 1].map(|j| Q[i][j] + next[i][j]));
            gains.push(gain);
        }
        let mut state = self.start;
        let act = |gain: State| {
            let a = -dot(gain, state);
            state = [0, 1].map(|i| dot(A[i], state) + B[i] * a);
            a
        };
        gains.into_iter().rev().map(act).collect()
    }
}

fn dot(a: State, b: State) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

fn times(m: Matrix, v: State) -> State {
    m.map(|row| dot(row, v))
}

fn transpose(m: Matrix) -> Matrix {
    [[m[0][0], m[1][0]], [m[0][1], m[1][1]]]
}

fn product(a: Matrix, b: Matrix) -> Matrix {
    a.map(|row| transpose(b).map(|column| dot(row, column)))
}

#[test]
fn lqr_gradient_vanishes_at_the_closed_form_optimum() {
    for env in 0..3 {
        let lqr = Lqr::new(env);
        let slopes = lqr.gradient(&lqr.optimum());
        assert!(slopes.iter().all(|slope| slope.abs() < 1e-9), "{slopes:?}");
    }
}
