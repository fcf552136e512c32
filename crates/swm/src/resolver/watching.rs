//! Policies that plan while something reads their searches.

use super::{HomeResolver, Planner, check_trained_on, parse_score};
use serde_json::Value;
use swm_core::{CostModel, Error, Policy, Predictor, Result};
use swm_eval::{Choice, Model, World};
use swm_plan::{ActionScale, PlanObserver, SimulatorCost};

/// A policy whose searches are read, and the scale of its actions.
pub struct WatchedPolicy {
    /// The policy.
    pub policy: Box<dyn Policy>,
    /// The scale.
    pub scale: ActionScale,
    /// The world model, if it offers predictions.
    pub predictor: Option<Box<dyn Predictor>>,
}

impl HomeResolver {
    /// Makes a policy that plans in the simulator or in a checkpoint, with a solver and settings of model-predictive control.
    /// `observer` reads its searches.
    ///
    /// # Errors
    /// When a setting is invalid, or the checkpoint does not plan, or the solver does not fit.
    pub fn watched_policy(
        &self,
        model: &Model,
        (solver, mpc): (&Choice, &Value),
        world: &World,
        observer: Box<dyn PlanObserver>,
    ) -> Result<WatchedPolicy> {
        let (spec, planner) = (world.spec(), Planner::new(solver, mpc, &Value::Null)?);
        let mut predictor = None;
        let (cost, scale): (Box<dyn CostModel>, ActionScale) = match model {
            Model::Simulator { score } => {
                let (scale, score) = (ActionScale::unscaled(spec), parse_score(score)?);
                let block = planner.mpc.action_block;
                (Box::new(SimulatorCost::new(self.maker(spec)?, scale.clone(), block, score)?), scale)
            }
            Model::Checkpoint(given) => {
                let loaded = self.checkpoint(given)?;
                let info = loaded.info()?;
                check_trained_on(&info, given, spec)?;
                let cost = loaded.cost().ok_or_else(|| {
                    let problem = format!("a {} model acts and does not predict", info.family);
                    Error::config(format!("checkpoint {given}"), problem, "choose another model")
                })?;
                predictor = loaded.predictor();
                (cost, info.dataset_info.action)
            }
            _ => {
                let fix = "choose the simulator or a checkpoint";
                return Err(Error::config("the model", "its searches cannot be read", fix));
            }
        };
        let policy = planner.policy(cost, scale.clone(), world)?.observed(observer);
        Ok(WatchedPolicy { policy: Box::new(policy), scale, predictor })
    }
}
