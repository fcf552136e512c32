//! [`Settings`]: how a page plans.

use super::{Model, SIMULATOR};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use swm_core::{EnvSpec, Error, Result};
use swm_plan::{MpcConfig, SOLVERS};

/// The largest number of candidates, iterations and other counts of a solver.
const MOST_COUNT: u64 = 10_000;
/// The largest number of environment steps of a plan.
const MOST_STEPS: usize = 1_000;
/// The largest number of values of the candidates of an iteration: 64 MiB.
const MOST_VALUES: usize = 1 << 24;

/// How a page plans.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// The name of the model.
    pub model: String,
    /// The id of the solver.
    pub solver: String,
    /// The settings of the solver; those left out have their defaults.
    #[serde(default)]
    pub settings: Map<String, Value>,
    /// Model steps of a plan.
    pub horizon: usize,
    /// Model steps that are executed before the next plan.
    pub receding: usize,
    /// Environment steps of a model step in the simulator.
    pub block: usize,
    /// What the simulator minimises: `terminal`, `running`, `reach` or `success`.
    pub score: String,
    /// Whether a plan starts from what the last one left.
    pub warm: bool,
}

impl Settings {
    /// Returns the environment steps in a model step.
    pub fn block(&self, model: &Model) -> usize {
        model.block.unwrap_or(self.block)
    }

    /// Returns the settings of model-predictive control, for a model that this crate checks the sizes of.
    ///
    /// # Errors
    /// When a count is 0 or so large that a plan would not fit the page, or the solver is unknown.
    pub fn mpc(&self, model: &Model, spec: &EnvSpec) -> Result<MpcConfig> {
        let config = MpcConfig {
            horizon: self.horizon,
            receding_horizon: self.receding,
            action_block: self.block(model),
            warm_start: self.warm,
            history: model.history,
            latency_budget: None,
            fast: false,
        };
        config.check()?;
        let steps = self.horizon.saturating_mul(config.action_block);
        let check = |holds: bool, what: &str, given: String, fix: String| {
            if holds { Ok(()) } else { Err(Error::config(what, given, fix)) }
        };
        let fix = format!("choose a horizon of at most {MOST_STEPS} environment steps");
        check(steps <= MOST_STEPS, "the horizon of a plan", format!("it has {steps} environment steps"), fix)?;
        SOLVERS.get(&self.solver)?;
        for (name, value) in &self.settings {
            let count = value.as_u64().unwrap_or_default();
            let fix = format!("choose at most {MOST_COUNT}");
            check(count <= MOST_COUNT, &format!("{} {name}", self.solver), count.to_string(), fix)?;
        }
        let width = spec.action_space.len().max(1);
        let samples = self.settings.get("samples").and_then(Value::as_u64).unwrap_or(512) as usize;
        let values = samples.saturating_mul(steps).saturating_mul(width);
        let fix = format!("choose fewer samples or a shorter horizon: at most {MOST_VALUES} values");
        check(values <= MOST_VALUES, "the candidates of a search", format!("{values} values"), fix)?;
        Ok(config)
    }

    /// Returns the solver as the command line names it: `cem,samples=64`.
    pub fn solver_text(&self) -> String {
        let settings = self.settings.iter().map(|(key, value)| match value {
            Value::String(text) => format!(",{key}={text}"),
            value => format!(",{key}={value}"),
        });
        std::iter::once(self.solver.clone()).chain(settings).collect()
    }

    /// Returns the command that evaluates this planner.
    pub fn command(&self, spec: &EnvSpec) -> String {
        format!("swm eval {}", self.arguments(spec).join(" "))
    }

    /// Returns the arguments of that command.
    pub fn arguments(&self, spec: &EnvSpec) -> Vec<String> {
        let mut arguments = vec![self.model.clone()];
        let mut add = |option: &str, value: String| arguments.extend([option.to_owned(), value]);
        add("--env", spec.id.clone());
        add("--solver", self.solver_text());
        add("--horizon", self.horizon.to_string());
        add("--receding-horizon", self.receding.to_string());
        if self.model == SIMULATOR {
            add("--action-block", self.block.to_string());
            add("--score", self.score.clone());
        }
        if !self.warm {
            arguments.push("--cold-start".to_owned());
        }
        arguments
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn settings(change: Value) -> Settings {
        let mut all = json!({
            "model": "simulator", "solver": "cem", "settings": {"samples": 64}, "horizon": 5, "receding": 2, "block": 5,
            "score": "terminal", "warm": true,
        });
        for (key, value) in change.as_object().expect("settings") {
            all[key] = value.clone();
        }
        serde_json::from_value(all).expect("settings")
    }

    #[test]
    fn settings_that_would_not_fit_are_errors() {
        let spec = swm_envs::ENVS.choose("swm/TwoRoom-v1").and_then(|choice| choice.env()).expect("it").spec().clone();
        let model = Model { name: "simulator".to_owned(), family: String::new(), block: None, image: None, history: 1 };
        let mpc = settings(json!({})).mpc(&model, &spec).expect("valid settings");
        assert_eq!((mpc.horizon, mpc.receding_horizon, mpc.action_block), (5, 2, 5));
        for change in [
            json!({"horizon": 0}),
            json!({"receding": 6}),
            json!({"horizon": 1000}),
            json!({"block": 1_000_000}),
            json!({"solver": "magic"}),
            json!({"settings": {"samples": 100_000}}),
            json!({"settings": {"samples": 10_000}, "horizon": 200}),
            json!({"settings": {"iterations": 1_000_000_000_u64}}),
        ] {
            assert!(settings(change.clone()).mpc(&model, &spec).is_err(), "{change}");
        }
        let block = Model { block: Some(7), ..model };
        assert_eq!(settings(json!({})).mpc(&block, &spec).expect("valid settings").action_block, 7);
        assert_eq!(
            settings(json!({"warm": false})).command(&spec),
            "swm eval simulator --env swm/TwoRoom-v1 --solver cem,samples=64 --horizon 5 --receding-horizon 2 \
             --action-block 5 --score terminal --cold-start"
        );
    }
}
