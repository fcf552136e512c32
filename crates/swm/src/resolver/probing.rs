//! Policies that plan by the states that a probe reads from the latents of a world model.

use super::{HomeResolver, Planner, check_trained_on};
use crate::home;
use std::sync::Arc;
use swm_core::run::Control;
use swm_core::{CostModel, EnvSpec, Error, Result};
use swm_eval::{Predictor, ResolvedPolicy, World};
use swm_models::probe::{ProbedCost, ProbedLatents, StateConfig, StateProbe};
use swm_plan::SimulatedLatents;

/// A probe, and the hash of the content of the dataset that it was fitted on.
pub(super) type FittedProbe = (Arc<StateProbe>, String);

impl HomeResolver {
    /// Makes a policy that plans as with a checkpoint, by the states that a probe reads from its latents.
    pub(super) fn probe_policy(
        &self,
        name: &str,
        (given, dataset, columns): (&str, &str, &[String]),
        true_dynamics: bool,
        planner: Planner,
        world: &World,
    ) -> Result<ResolvedPolicy> {
        let loaded = self.checkpoint(given)?;
        let info = loaded.info()?;
        check_trained_on(&info, given, world.spec())?;
        let predictor = || {
            loaded.predictor().ok_or_else(|| {
                let problem = format!("a {} model offers no latents of observations", info.family);
                Error::config(
                    format!("checkpoint {given}"),
                    problem,
                    "leave out C (an autopsy), or give another checkpoint",
                )
            })
        };
        let (probe, hash) = self.probe(predictor()?, (given, dataset, columns), world.spec())?;
        let (scale, block, model) = (info.dataset_info.action.clone(), planner.mpc.action_block, predictor()?);
        let cost: Box<dyn CostModel> = if true_dynamics {
            let model = Box::new(ProbedLatents { model, probe });
            Box::new(SimulatedLatents::new(self.maker(world.spec())?, scale.clone(), block, model)?)
        } else {
            Box::new(ProbedCost::new(model, probe, scale.clone(), block)?)
        };
        let policy = planner.policy(cost, scale, world)?;
        let policy = ResolvedPolicy { probe_dataset: Some(hash), ..self.traced(name, policy) };
        Ok(self.with_provenance(policy, info))
    }

    /// Returns a probe, and the hash of the content of its dataset; it is fitted at the first call.
    fn probe(
        &self,
        mut predictor: Box<dyn Predictor>,
        (given, dataset, columns): (&str, &str, &[String]),
        spec: &EnvSpec,
    ) -> Result<FittedProbe> {
        let key = (given.to_owned(), dataset.to_owned(), columns.to_vec());
        if let Some(probe) = self.probes.borrow().get(&key) {
            return Ok(probe.clone());
        }
        self.check_local("dataset", dataset)?;
        let reader = home::open_dataset(dataset)?;
        let angles = spec.angles.iter().map(|(column, index)| ((*column).to_owned(), *index)).collect();
        let config = StateConfig { angles, ..StateConfig::new(columns.to_vec()) };
        let probe = StateProbe::fit(&mut *predictor, &*reader, &config, &mut Control::new())?;
        let fitted = (Arc::new(probe), reader.content_hash()?);
        self.probes.borrow_mut().insert(key, fitted.clone());
        Ok(fitted)
    }
}
