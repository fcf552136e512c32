//! Checks of registry entries and their specs.

use crate::Suite;
use swm_core::columns::STATE;
use swm_core::{DType, Schema, Space};

/// Checks that entries have unique ids and complete specs: actions, columns, factors, experts.
pub fn entries_are_complete_and_have_unique_ids(suite: &Suite) {
    for entry in suite.rows {
        let (env, id) = (entry.env().expect("creating the environment"), entry.id);
        let spec = env.spec();
        assert_eq!(spec.id, id);
        assert_eq!(suite.rows.iter().filter(|other| other.id == id).count(), 1, "{id} must be listed once");
        assert!(!entry.summary.is_empty(), "{id} must have a summary");
        assert!(spec.max_episode_steps > 0, "{id} must have a time limit of at least 1 step");
        let schema = Schema::new(spec.columns.clone()).unwrap_or_else(|error| panic!("{id}: {error}"));
        assert!(schema.find(STATE).is_some(), "{id} must observe its state");
        for &(name, element) in &spec.angles {
            let column = schema.column(name).unwrap_or_else(|error| panic!("{id}, angles: {error}"));
            assert!(element < column.len(), "{id}: the angle {name}[{element}] is not in the column");
        }
        let supported = match spec.action_space {
            Space::Box { dtype, .. } => dtype == DType::Float32,
            Space::Discrete { .. } | Space::MultiDiscrete { .. } => true,
            Space::Rgb => false,
        };
        assert!(supported, "{id}: the action space must be a float32 box, discrete or multi-discrete");
        assert!(!suite.require_experts || !entry.experts.is_empty(), "{id} must have an expert");
        for (i, expert) in entry.experts.iter().enumerate() {
            assert!(
                entry.experts[..i].iter().all(|other| other.id != expert.id),
                "{id} has two experts '{}'",
                expert.id
            );
            assert!(!expert.summary.is_empty(), "{id}: the expert '{}' must have a summary", expert.id);
        }
        assert!(!spec.variation_space.factors().is_empty(), "{id} must have factors of variation");
    }
}
