//! Strict and compat counting, in an environment on a line whose outcomes are known.

use crate::evaluating::{pinned, recorded, run_counted, world};
use crate::line::Walker;
use swm_core::policy::write_action;
use swm_core::results::{Counting, Run};
use swm_core::run::Control;
use swm_core::{Batch, Key, Policy, RandomPolicy, Result, VariationRequest};
use swm_eval::{EvalConfig, Starts};

/// A policy that always moves to the right, past the goal.
struct MoveRight;

impl Policy for MoveRight {
    fn begin(&mut self, _: usize, _: Key) {}

    fn act(&mut self, _: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        (0..active.len()).for_each(|slot| write_action(&mut actions.row_mut(slot), 0, &[1.0]));
        Ok(())
    }
}

#[test]
fn hold_rejects_episodes_that_move_past_the_goal() {
    // From -2 to 2 in steps of 1: at the goal after 4 steps, beyond it after 5.
    let starts = Starts::episodic(2, 0, pinned(&[("agent.x", -2.0), ("goal.x", 2.0)])).expect("creating the starts");
    let play = |policy: &mut dyn Policy, hold| {
        let found = run_counted(&mut world(2, 1), policy, &starts, Counting::Strict { hold });
        let first = &found.episodes[0];
        (found.success.successes, first.steps, first.time_to_goal())
    };
    assert_eq!(play(&mut Walker, 1), (2, 4, Some(4)));
    assert_eq!(play(&mut Walker, 3), (2, 6, Some(4)), "held from the fourth step on");
    assert_eq!(play(&mut MoveRight, 1), (2, 4, Some(4)));
    assert_eq!(play(&mut MoveRight, 2), (0, 12, None), "the episode lasts until the budget ends");
}

#[test]
fn hold_beyond_the_budget_is_an_error() {
    let starts = Starts::episodic(1, 0, VariationRequest::default()).expect("creating the starts");
    for hold in [0, 13] {
        let config = EvalConfig { counting: Counting::Strict { hold }, ..EvalConfig::default() };
        let error = world(1, 1)
            .evaluate(&mut Walker, &starts, &config, &mut Control::default())
            .expect_err("the input is invalid");
        assert!(error.to_string().contains(&format!("{hold} in a budget of 12")), "{error}");
    }
}

#[test]
fn compat_counting_plays_solved_starts_and_reports_the_strict_rate() {
    let reader = recorded(12);
    let spec = world(1, 1).spec().clone();
    let picks = Starts::choose(&reader, 40, 1, 3).expect("the dataset has enough starts");
    let starts =
        Starts::from_dataset(&reader, world(1, 1).pool().env(0), picks, 1, 3, VariationRequest::default(), &[])
            .expect("creating the starts");
    let mut random = RandomPolicy::new(&spec, 5);
    let strict = run_counted(&mut world(5, 1), &mut random, &starts, Counting::Strict { hold: 1 });
    let compat = run_counted(&mut world(5, 2), &mut random, &starts, Counting::Compat { envs: 40 });
    assert!(strict.solved_at_start > 0 && strict.solved_at_start == compat.solved_at_start);
    assert_eq!(compat.success.n, 40, "every start counts");
    assert_eq!(compat.strict, Some(strict.success), "one run gives both rates");
    assert_eq!(strict.strict, None);
    for (strict, compat) in strict.episodes.iter().zip(&compat.episodes) {
        assert!(compat.steps > 0, "every start is played");
        assert!(strict.solved_at_start || strict == compat);
    }
    let solved_and_counted =
        compat.episodes.iter().filter(|episode| episode.solved_at_start && episode.success).count();
    assert_eq!(compat.success.successes, strict.success.successes + solved_and_counted);
    assert!(solved_and_counted > 0);
}

#[test]
fn episodic_compat_counting_counts_the_first_finished_episodes() {
    let all = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let play = |envs, threads| -> Run {
        let starts = Starts::sequential(20, 100, all.clone()).expect("creating the starts");
        run_counted(&mut world(envs, threads), &mut MoveRight, &starts, Counting::Compat { envs })
    };
    // The expected values were computed by `World.evaluate(episodes=20, seed=100)` of stable-worldmodel 0.1.1, for
    // environments with the same episode lengths and outcomes: the last counted seed and the number of successes.
    for (envs, last, successes) in [(1, 119, 7), (3, 119, 7), (8, 122, 8), (20, 122, 8)] {
        let found = play(envs, 2);
        let seeds: Vec<u64> = found.episodes.iter().map(|episode| episode.seed).collect();
        let expected: Vec<u64> = (100..=118).chain([last]).collect();
        assert_eq!(seeds, expected, "{envs} environments");
        assert_eq!((found.success.successes, found.success.n), (successes, 20));
        assert_eq!(found.episodes, play(envs, 1).episodes, "results do not depend on threads");
        assert_eq!(found.strict, None, "strict counting selects other episodes");
    }
    let starts = Starts::sequential(2, 0, all).expect("creating the starts");
    let config = EvalConfig { counting: Counting::Compat { envs: 2 }, ..EvalConfig::default() };
    let error = world(3, 1)
        .evaluate(&mut MoveRight, &starts, &config, &mut Control::default())
        .expect_err("the request is rejected");
    assert!(error.to_string().contains("among 2 environments, and the world has 3"), "{error}");
}
