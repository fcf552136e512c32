//! Checks of reset requests: factors, groups, pinned values and invalid options.

use super::probe::{Probe, all_varied, assert_finite, vary};
use crate::Suite;
use swm_core::columns::STATE;
use swm_core::{EnvEntry, Factor, Key, ResetOptions};

/// Checks that every factor, every group, and all factors together can be sampled.
pub fn every_factor_and_group_can_be_sampled(suite: &Suite) {
    for entry in suite.rows {
        let mut probe = Probe::new(suite, entry);
        let space = probe.env.spec().variation_space.clone();
        let mut keys: Vec<String> = vec!["all".to_owned()];
        for factor in space.factors() {
            keys.push(factor.key.clone());
            keys.extend(factor.key.split_once('.').map(|(group, _)| group.to_owned()));
        }
        keys.dedup();
        let requests = (0..10 * suite.requests)
            .map(|_| "all")
            .chain(keys.iter().flat_map(|key| vec![key.as_str(); suite.requests]));
        for (seed, key) in (0..).zip(requests) {
            let options = ResetOptions { variation: vary(&[key]), ..ResetOptions::default() };
            let label = format!("{}, '{key}', seed {seed}", entry.id);
            probe.env.reset(seed, &options).unwrap_or_else(|error| panic!("{label}: {error}"));
            let chosen = space.select(key).expect("selecting the factors");
            for (i, (factor, (_, value))) in space.factors().iter().zip(probe.env.factors().iter()).enumerate() {
                factor.space.check(&factor.key, value).unwrap_or_else(|error| panic!("{label}: {error}"));
                assert!(
                    chosen.contains(&i) || value == factor.init_value,
                    "{label}: {} varies without being requested",
                    factor.key
                );
            }
            assert_finite(probe.observed(), &label);
            (0..3).for_each(|t| {
                probe.step(Key::new(seed), t);
            });
            assert_finite(probe.observed(), &label);
        }
    }
}

/// Checks that many resets with all factors varied succeed.
pub fn resets_with_all_factors_varied_succeed(suite: &Suite) {
    let resets = suite.resets;
    let check = |entry: &EnvEntry, seeds: std::ops::Range<u64>| {
        let (mut probe, options) = (Probe::new(suite, entry), all_varied());
        for seed in seeds {
            probe.env.reset(seed, &options).unwrap_or_else(|error| panic!("{}, seed {seed}: {error}", entry.id));
            let values = probe.env.factors();
            for (factor, (key, value)) in values.factors().iter().zip(values.iter()) {
                factor.space.check(key, value).unwrap_or_else(|error| panic!("{}, seed {seed}: {error}", entry.id));
            }
            assert!(probe.env.goal_distance().is_finite(), "{}, seed {seed}", entry.id);
        }
    };
    std::thread::scope(|scope| {
        for half in [0..resets / 2, resets / 2..resets] {
            let check = &check;
            scope.spawn(move || suite.rows.iter().for_each(|entry| check(entry, half.clone())));
        }
    });
}

/// Checks that a request may combine groups, factors and pinned values.
pub fn requests_combine_groups_factors_and_pinned_values(suite: &Suite) {
    for entry in suite.rows {
        let mut probe = Probe::new(suite, entry);
        let space = probe.env.spec().variation_space.clone();
        let factors = space.factors();
        let groups: std::collections::BTreeSet<&str> = factors.iter().filter_map(|f| f.key.split('.').next()).collect();
        for (seed, group) in (0..).zip(groups) {
            // A group and one factor of another group vary; a colour is pinned to the sample of another seed.
            let inside = |factor: &&Factor| factor.key.starts_with(&format!("{group}."));
            let other = factors.iter().find(|factor| !inside(factor));
            let sampled = space.resolve(&vary(&["all"]), Key::new(1000 + seed)).expect("sampling the factors");
            let mut request = vary(&[group]);
            request.variation.iter_mut().for_each(|keys| keys.extend(other.map(|factor| factor.key.clone())));
            let pinned = factors
                .iter()
                .filter(inside)
                .chain(factors.iter().rev().filter(|f| !inside(f)))
                .find(|factor| factor.key.ends_with("color") && other.is_none_or(|other| other.key != factor.key));
            request
                .variation_values
                .extend(pinned.map(|factor| (factor.key.clone(), sampled.get(&factor.key).to_vec())));
            let label = format!("{}, {request:?}", entry.id);
            let options = ResetOptions { variation: request.clone(), ..ResetOptions::default() };
            probe.env.reset(seed, &options).unwrap_or_else(|error| panic!("{label}: {error}"));
            for (factor, (key, value)) in factors.iter().zip(probe.env.factors().iter()) {
                if let Some(expected) = request.variation_values.get(key) {
                    assert_eq!(value, expected, "{label}: {key} does not have its pinned value");
                } else if !inside(&factor) && other.is_none_or(|other| other.key != key) {
                    assert_eq!(value, factor.init_value, "{label}: {key} varies without being requested");
                }
            }
        }
    }
}

/// Checks that unknown factors, values out of bounds, and states of a wrong length or with NaNs are errors.
pub fn invalid_resets_are_errors(suite: &Suite) {
    for entry in suite.rows {
        let mut probe = Probe::reset(suite, entry, 0, &ResetOptions::default());
        let mut expect_error = |options: ResetOptions, words: &str| {
            let error = probe.env.reset(0, &options).expect_err(words).to_string();
            assert!(error.contains(words), "{}: {error}", entry.id);
        };
        expect_error(
            ResetOptions { variation: vary(&["no.such.factor"]), ..ResetOptions::default() },
            "no.such.factor",
        );
        let space = entry.env().expect("creating the environment").spec().variation_space.clone();
        for factor in space.factors() {
            let low = factor.space.bounds(0).0 - 1.0;
            for value in [vec![low; factor.space.len()], vec![f64::NAN; factor.space.len()], vec![]] {
                let mut variation = vary(&[]);
                variation.variation_values.insert(factor.key.clone(), value);
                expect_error(ResetOptions { variation, ..ResetOptions::default() }, &factor.key);
            }
        }
        let n = probe.column(STATE).len();
        for state in [vec![], vec![0.0; n + 1], vec![f64::NAN; n]] {
            for goal in [false, true] {
                let (state, goal_state) = if goal { (None, Some(state.clone())) } else { (Some(state.clone()), None) };
                let options = ResetOptions { state, goal_state, ..ResetOptions::default() };
                assert!(probe.env.reset(0, &options).is_err(), "{}: {options:?}", entry.id);
            }
        }
    }
}
