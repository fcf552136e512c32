//! Checks of observations, frames and the handling of invalid actions.

use super::probe::{Probe, all_varied, assert_finite, bytes_of};
use crate::Suite;
use swm_core::{Action, FrameMut, Key, ResetOptions, Space};

/// Checks that rows and frames do not depend on the previous content of their memory.
pub fn observations_and_frames_are_fully_written(suite: &Suite) {
    for entry in suite.rows {
        let mut probe = Probe::reset(suite, entry, 3, &all_varied());
        probe.step(Key::new(0), 0);
        let [zeros, ones] = [0, 255].map(|fill| {
            for column in 0..probe.row.schema().columns().len() {
                probe.row.bytes_mut(column).fill(fill);
            }
            bytes_of(probe.observed())
        });
        assert!(zeros == ones, "{}: observe does not write every byte", entry.id);
        for &(height, width) in suite.frame_sizes {
            let mut draw = |fill, goal| {
                let mut rgb = vec![fill; height * width * 3];
                let frame = FrameMut::new(width, height, &mut rgb);
                if goal {
                    probe.env.render_goal(frame).expect("rendering the goal")
                } else {
                    probe.env.render(frame).expect("rendering a frame")
                }
                rgb
            };
            assert!(draw(0, false) == draw(255, false), "{}: {height} x {width} frame is not fully written", entry.id);
            assert!(
                draw(0, true) == draw(255, true),
                "{}: {height} x {width} goal frame is not fully written",
                entry.id
            );
        }
    }
}

/// Checks that actions of the wrong kind, dimension or value are errors and leave the state unchanged.
pub fn invalid_actions_are_errors_without_effect(suite: &Suite) {
    for entry in suite.rows {
        let mut probe = Probe::reset(suite, entry, 0, &ResetOptions::default());
        let before = probe.env.snapshot();
        let n = probe.env.spec().action_dim();
        let space = probe.env.spec().action_space.clone();
        let invalid: Vec<Action<'_>> = match space {
            Space::Discrete { .. } | Space::MultiDiscrete { .. } => {
                let outside = |sign: i64| {
                    let end = |i| if sign < 0 { space.bounds(i).0 as i64 - 1 } else { space.bounds(i).1 as i64 + 1 };
                    Action::Discrete((0..n).map(end).collect::<Vec<_>>().leak())
                };
                vec![outside(-1), outside(1), Action::Discrete(vec![0; n + 1].leak()), Action::Continuous(&[0.0])]
            }
            _ => vec![
                Action::Discrete(&[0]),
                Action::Continuous(&[]),
                Action::Continuous(vec![0.0; n + 1].leak()),
                Action::Continuous(vec![f32::NAN; n].leak()),
                Action::Continuous(vec![f32::INFINITY; n].leak()),
                Action::Continuous(vec![f32::NEG_INFINITY; n].leak()),
            ],
        };
        for action in invalid {
            let error = probe.env.step(action).expect_err("an invalid action").to_string();
            assert!(error.len() > 10, "{}: the error '{error}' is too short", entry.id);
            assert!(probe.env.snapshot() == before, "{}: {action:?} changed the state", entry.id);
        }
        if let Space::Box { .. } = probe.env.spec().action_space {
            // A finite action far outside the space is an error, or leaves the state finite.
            let _ = probe.env.step(Action::Continuous(&vec![1e6; n]));
            assert_finite(probe.observed(), entry.id);
        }
    }
}
