//! Checks that every factor of variation changes an output.

use super::probe::{Probe, bytes_of, vary};
use crate::Suite;
use swm_core::{EnvEntry, Factor, Key, ResetOptions, VariationRequest, VariationSpace};

/// Requests the defaults of all factors, with the `rendering.*` factors at their upper bounds: at 0, the
/// `rendering.*` factors hide the effects of other factors.
fn all_visible(space: &VariationSpace) -> VariationRequest {
    let mut request = vary(&[]);
    for factor in space.factors().iter().filter(|factor| factor.key.starts_with("rendering.")) {
        request.variation_values.insert(factor.key.clone(), vec![factor.space.bounds(0).1]);
    }
    request
}

/// Resets with a request. Returns the frame, the observation, and the observation after four steps and a new goal.
fn outcome(suite: &Suite, entry: &EnvEntry, variation: VariationRequest) -> Option<(Vec<u8>, Vec<u8>, Vec<u8>)> {
    let mut probe = Probe::new(suite, entry);
    probe.env.reset(5, &ResetOptions { variation, ..ResetOptions::default() }).ok()?;
    let (frame, row) = (probe.frame(), bytes_of(probe.observed()));
    (0..4).for_each(|t| {
        probe.step(Key::new(5), t);
    });
    probe.env.sample_goal(Key::new(5)).ok()?;
    let later = bytes_of(probe.observed());
    Some((frame, row, later))
}

/// The number of tried values of a factor, and the number of values that changed each output of [`outcome`].
#[derive(Default)]
struct Effects {
    tried: usize,
    frame: usize,
    row: usize,
    later: usize,
}

fn effects(suite: &Suite, entry: &EnvEntry, factor: &Factor, context: &VariationRequest) -> Effects {
    let mut effects = Effects::default();
    let Some(base) = outcome(suite, entry, context.clone()) else { return effects };
    let mut rng = Key::new(1).with(&factor.key).rng();
    for _ in 0..600 {
        let value = factor.space.sample(&mut rng);
        if effects.tried == suite.values {
            break;
        }
        if context.variation_values.get(&factor.key).unwrap_or(&factor.init_value) == &value {
            continue;
        }
        let mut request = context.clone();
        request.variation_values.insert(factor.key.clone(), value);
        // Constraints may exclude a value, depending on the other factors.
        let Some(outcome) = outcome(suite, entry, request) else { continue };
        effects.tried += 1;
        effects.frame += usize::from(outcome.0 != base.0);
        effects.row += usize::from(outcome.1 != base.1);
        effects.later += usize::from(outcome.2 != base.2);
    }
    effects
}

/// Checks that every factor changes an output, and that colours change frames only.
pub fn every_factor_changes_an_output(suite: &Suite) {
    for entry in suite.rows {
        let space = entry.env().expect("creating the environment").spec().variation_space.clone();
        let defaults = all_visible(&space);
        // Some factors have an effect only for certain values of another factor. For example, the angle of a shape
        // changes nothing while the shape has its default, a circle.
        let mut contexts = vec![defaults.clone()];
        for seed in 0..suite.contexts {
            let mut request = all_visible(&space);
            for (key, value) in space.resolve(&vary(&["all"]), Key::new(seed)).expect("sampling the factors").iter() {
                request.variation_values.entry(key.to_owned()).or_insert_with(|| value.to_vec());
            }
            contexts.push(request);
        }
        for factor in space.factors() {
            let id = format!("{}, {}", entry.id, factor.key);
            if let Some((_, _, why)) =
                suite.inert_factors.iter().find(|(env, key, _)| *env == entry.id && *key == factor.key)
            {
                let mut all = contexts.iter().map(|context| effects(suite, entry, factor, context));
                assert!(all.all(|e| e.frame + e.row + e.later == 0), "{id} has an effect, but {why}");
                continue;
            }
            let Effects { tried, frame, row, later } = effects(suite, entry, factor, &defaults);
            assert!(tried > 0, "{id}: no value satisfies the constraints given the defaults");
            let name = factor.key.rsplit('.').next().unwrap_or_default();
            if name.ends_with("color") {
                assert_eq!((frame, row, later), (tried, 0, 0), "{id} must change the frame only");
            } else if ["size", "scale", "radius", "thickness", "shape", "axis"].contains(&name) {
                assert!(frame * 4 >= tried * 3, "{id} changes the frame only {frame} of {tried} times");
            } else if name.ends_with("position") {
                assert_eq!(frame.max(row), tried, "{id} must change the frame or the state");
            } else {
                let mut all = contexts.iter().map(|context| effects(suite, entry, factor, context));
                assert!(all.any(|e| e.frame + e.row + e.later > 0), "{id} has no effect");
            }
        }
    }
}
