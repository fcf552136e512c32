//! Tests that a linear read-out of the state, trained on frames of one renderer, has the same error on frames of the
//! other renderer.

use rand::Rng;
use swm_core::{Action, Batch, FrameMut, Key, ResetOptions, Schema};
use swm_mujoco::ENVS;
use swm_mujoco::render::{self, Choice};

const ID: &str = "swm/CheetahDMControl-v0";
const SIDE: usize = 64;
/// Pixels are averaged over squares of this side.
const POOL: usize = 4;
const EPISODES: u64 = 25;
const STEPS: usize = 12;
/// Every fourth episode is held out for testing.
const HELD_OUT: usize = 4;
/// The ridge penalty on the weights.
const RIDGE: f64 = 1.0;

/// The mean colours of all squares (0 to 1), followed by a constant 1.
fn features(rgb: &[u8]) -> Vec<f64> {
    let side = SIDE / POOL;
    let mut sums = vec![0.0; side * side * 3];
    for (i, &byte) in rgb.iter().enumerate() {
        let (x, y, channel) = (i / 3 % SIDE, i / 3 / SIDE, i % 3);
        sums[((y / POOL) * side + x / POOL) * 3 + channel] += f64::from(byte) / 255.0 / (POOL * POOL) as f64;
    }
    sums.push(1.0);
    sums
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Solves a symmetric positive definite system for several right-hand sides, by elimination.
fn solve(mut a: Vec<Vec<f64>>, mut b: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let n = a.len();
    for i in 0..n {
        let (pivot, right) = (a[i].clone(), b[i].clone());
        for j in i + 1..n {
            let by = a[j][i] / pivot[i];
            a[j].iter_mut().zip(&pivot).for_each(|(x, p)| *x -= by * p);
            b[j].iter_mut().zip(&right).for_each(|(x, p)| *x -= by * p);
        }
    }
    for i in (0..n).rev() {
        for k in 0..b[i].len() {
            let known: f64 = (i + 1..n).map(|j| a[i][j] * b[j][k]).sum();
            b[i][k] = (b[i][k] - known) / a[i][i];
        }
    }
    b
}

#[test]
#[ignore = "renders 300 frames with OpenGL"]
#[allow(clippy::print_stderr, clippy::too_many_lines, reason = "one experiment with a table for `--no-capture`")]
fn pose_read_out_error_is_similar_for_frames_of_both_renderers() {
    let mut env = ENVS.get(ID).and_then(|entry| entry.env()).expect("creating the environment");
    let (mut poses, mut frames) = (vec![], [vec![], vec![]]);
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("creating the schema"), 1);
    for episode in 0..EPISODES {
        env.reset(episode, &ResetOptions::default()).expect("resetting the environment");
        let mut rng = Key::new(episode).rng();
        for _ in 0..STEPS {
            for _ in 0..3 {
                let action: Vec<f32> = (0..env.spec().action_dim()).map(|_| rng.random_range(-1.0..1.0)).collect();
                env.step(Action::Continuous(&action)).expect("stepping the environment");
            }
            env.observe(&mut row.row_mut(0));
            // The camera follows the cheetah, so frames do not show its position along the track.
            poses.push(row.row(0).to_f64("qpos").expect("reading a column")[1..].to_vec());
            for (choice, frames) in [Choice::Egl, Choice::Cpu].into_iter().zip(&mut frames) {
                let mut rgb = vec![0; SIDE * SIDE * 3];
                render::with(choice, || env.render(FrameMut::new(SIDE, SIDE, &mut rgb))).expect("rendering a frame");
                frames.push(features(&rgb));
            }
        }
    }
    let held_out = |i: &usize| (i / STEPS).is_multiple_of(HELD_OUT);
    let train: Vec<usize> = (0..poses.len()).filter(|i| !held_out(i)).collect();
    let test: Vec<usize> = (0..poses.len()).filter(held_out).collect();
    let error = |trained: &[Vec<f64>], tested: &[Vec<f64>]| -> f64 {
        // The dual form: one weight per frame instead of one per feature.
        let mut kernel: Vec<Vec<f64>> =
            train.iter().map(|&i| train.iter().map(|&j| dot(&trained[i], &trained[j])).collect()).collect();
        kernel.iter_mut().enumerate().for_each(|(i, row)| row[i] += RIDGE);
        let weights = solve(kernel, train.iter().map(|&i| poses[i].clone()).collect());
        let squares: f64 = test
            .iter()
            .map(|&i| {
                let similarities: Vec<f64> = train.iter().map(|&j| dot(&trained[j], &tested[i])).collect();
                let read =
                    (0..poses[i].len()).map(|k| weights.iter().zip(&similarities).map(|(w, s)| w[k] * s).sum::<f64>());
                read.zip(&poses[i]).map(|(a, b)| (a - b).powi(2)).sum::<f64>()
            })
            .sum();
        (squares / test.len() as f64).sqrt()
    };
    let [egl, cpu] = &frames;
    for (name, trained, untrained) in [("egl", egl, cpu), ("cpu", cpu, egl)] {
        let (trained_error, untrained_error) = (error(trained, trained), error(trained, untrained));
        let mean: Vec<f64> =
            (0..poses[0].len()).map(|k| train.iter().map(|&i| poses[i][k]).sum::<f64>() / train.len() as f64).collect();
        let mean_error =
            (test.iter().map(|&i| poses[i].iter().zip(&mean).map(|(a, b)| (a - b).powi(2)).sum::<f64>()).sum::<f64>()
                / test.len() as f64)
                .sqrt();
        eprintln!(
            "trained on {name}: errors {trained_error:.4}, {untrained_error:.4} (other renderer), {mean_error:.4} (mean pose)"
        );
        assert!(trained_error < 0.7 * mean_error, "trained on {name}: the read-out is no better than the mean pose");
        assert!(
            (untrained_error - trained_error).abs() < 0.1 * trained_error,
            "trained on {name}: {trained_error} and {untrained_error}"
        );
    }
}
