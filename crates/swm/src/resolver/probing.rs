//! Policies that plan by the states that a probe reads from the latents of a world model.

use super::{HomeResolver, Planner, check_trained_on};
use crate::home;
use std::sync::Arc;
use swm_core::columns::{POS_AGENT, PROPRIO};
use swm_core::run::Control;
use swm_core::{Batch, CostModel, EnvSpec, Error, Result};
use swm_eval::{Predictor, ResolvedPolicy, World};
use swm_models::probe::{ProbedCost, ProbedLatents, StateConfig, StateProbe};
use swm_plan::SimulatedLatents;

/// A probe, and the hash of the content of the dataset that it was fitted on.
pub(super) type FittedProbe = (Arc<StateProbe>, String);

/// Columns that need no image, and the probe that reads states from them.
pub(crate) type ColumnProbe = (Vec<String>, StateProbe);

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
        let predictor = || loaded.predictor().ok_or_else(|| no_latents(given, info.family));
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

    /// The probe of the latents of a checkpoint, and that of columns that need no image. By default these are the position of the
    /// agent, `pos_agent`, else `proprio`; there is no such probe if the dataset has neither.
    ///
    /// # Errors
    /// When the model offers no latents of observations, a column or the dataset is missing, or the run is stopped.
    pub(crate) fn probes(
        &self,
        (given, dataset, columns): (&str, &str, &[String]),
        baseline: &[String],
        spec: &EnvSpec,
        control: &mut Control<'_>,
    ) -> Result<(Arc<StateProbe>, Option<ColumnProbe>)> {
        let loaded = self.checkpoint(given)?;
        let info = loaded.info()?;
        let predictor = loaded.predictor().ok_or_else(|| no_latents(given, info.family))?;
        let (probe, _) = self.probe(predictor, (given, dataset, columns), spec)?;
        let reader = home::open_dataset(dataset)?;
        let by_default = [POS_AGENT, PROPRIO].into_iter().find(|name| reader.schema().find(name).is_some());
        let by_default: Vec<String> = by_default.map(str::to_owned).into_iter().collect();
        let names = if baseline.is_empty() { by_default } else { baseline.to_vec() };
        if names.is_empty() {
            return Ok((probe, None));
        }
        let widths = names.iter().map(|name| Ok(reader.schema().column(name)?.shape.iter().product()));
        let mut known = Columns { widths: widths.collect::<Result<_>>()?, names };
        let of_known = StateProbe::fit(&mut known, &*reader, &config(columns, spec), control)?;
        Ok((probe, Some((known.names, of_known))))
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
        let probe = StateProbe::fit(&mut *predictor, &*reader, &config(columns, spec), &mut Control::new())?;
        let fitted = (Arc::new(probe), reader.content_hash()?);
        self.probes.borrow_mut().insert(key, fitted.clone());
        Ok(fitted)
    }
}

fn no_latents(checkpoint: &str, family: &str) -> Error {
    let problem = format!("a {family} model offers no latents of observations");
    let fix = "leave out C and --probe-data (an autopsy), or give another checkpoint";
    Error::config(format!("checkpoint {checkpoint}"), problem, fix)
}

/// The settings of a probe of columns, whose angles are those of the environment.
fn config(columns: &[String], spec: &EnvSpec) -> StateConfig {
    let angles = spec.angles.iter().map(|(column, index)| ((*column).to_owned(), *index)).collect();
    StateConfig { angles, ..StateConfig::new(columns.to_vec()) }
}

/// Columns in place of latents. It encodes only.
struct Columns {
    names: Vec<String>,
    /// The number of elements of each column in a row.
    widths: Vec<usize>,
}

impl Predictor for Columns {
    fn frameskip(&self) -> usize {
        1
    }

    fn columns(&self) -> Vec<String> {
        self.names.clone()
    }

    fn latent_dim(&self) -> usize {
        self.widths.iter().sum()
    }

    fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> Result<()> {
        let (dim, mut at) = (self.latent_dim(), 0);
        for (name, &width) in self.names.iter().zip(&self.widths) {
            let values = rows.to_f32(name)?;
            for (latent, values) in latents.chunks_exact_mut(dim).zip(values.chunks_exact(width)) {
                latent[at..at + width].copy_from_slice(values);
            }
            at += width;
        }
        Ok(())
    }

    fn rollout(&mut self, _start: &[f32], _actions: &[f32], _horizon: usize, _latents: &mut [f32]) -> Result<()> {
        Err(Error::config(self.names.join(","), "columns cannot be predicted from", "predict with a model"))
    }
}
