//! The policies that `swm eval` accepts by name, and their requests for the evaluation.

use super::planner::PlannerArgs;
use crate::capsule::EvaluationRecord;
use crate::home;
use crate::resolver::{HomeResolver, parse_score};
use crate::zoo;
use serde_json::Value;
use std::path::{Path, PathBuf};
use swm_core::{EnvChoice, Result};
use swm_eval::{Model, PolicyKind, PolicyRequest};
use swm_models::capsule::Capsule;

/// A policy that the command line names.
pub struct NamedPolicy {
    name: String,
    kind: NamedKind,
    /// The environment that the checkpoint was trained on, and the path of the checkpoint.
    pub env: Option<(String, PathBuf)>,
    /// The side of the images that the checkpoint was trained on, in pixels.
    pub image: Option<usize>,
    /// The evaluation in the capsule, if the policy is one.
    pub recorded: Option<EvaluationRecord>,
}

/// The kind of a named policy.
enum NamedKind {
    /// A policy without a solver.
    Direct(PolicyKind),
    /// Planning by stepping the environment itself.
    Simulator,
    /// A checkpoint that predicts. If it also acts (`direct`), it plans only if the command names a solver.
    Checkpoint { given: String, block: usize, history: usize, direct: Option<PolicyKind> },
}

impl NamedPolicy {
    /// Returns the policy with a name: `random`, `no-op`, `replay`, `nearest`, `expert`, an expert's id, `simulator`, or a checkpoint,
    /// which is loaded.
    ///
    /// # Errors
    /// When the environment or the checkpoint does not exist, or the checkpoint is damaged.
    pub fn find(given: &str, env: Option<&str>, resolver: &HomeResolver) -> Result<Self> {
        let without_checkpoint = |kind| Self { name: given.to_owned(), kind, env: None, image: None, recorded: None };
        let env = env.map(|env| resolver.choose_env(env)).transpose()?;
        let baseline = match given {
            "random" => Some(PolicyKind::Random),
            "no-op" => Some(PolicyKind::NoOp),
            "replay" => Some(PolicyKind::Replay),
            "nearest" => Some(PolicyKind::Nearest),
            _ => None,
        };
        if let Some(kind) = baseline {
            return Ok(without_checkpoint(NamedKind::Direct(kind)));
        }
        let trained = env.as_ref().and_then(|env| zoo::trained_expert(&env.entry, &env.id(), given));
        if let Some(trained) = trained {
            let kind = PolicyKind::Direct { checkpoint: trained, settings: Value::Null };
            return Ok(without_checkpoint(NamedKind::Direct(kind)));
        }
        if given == "expert" || env.is_some_and(|env| env.entry.experts.iter().any(|expert| expert.id == given)) {
            return Ok(without_checkpoint(NamedKind::Direct(PolicyKind::Expert { id: given.to_owned() })));
        }
        if given == "simulator" {
            return Ok(without_checkpoint(NamedKind::Simulator));
        }
        // The commit of a checkpoint on the hub is part of the request.
        let pinned = resolver.pinned_checkpoint(given)?;
        let name = Path::new(given).file_name().map_or(given.to_owned(), |name| name.to_string_lossy().into_owned());
        let given = pinned.as_str();
        let loaded = resolver.checkpoint(given)?;
        let info = loaded.info()?;
        let direct = PolicyKind::Direct { checkpoint: given.to_owned(), settings: Value::Null };
        let kind = match loaded.cost() {
            Some(_) => NamedKind::Checkpoint {
                given: given.to_owned(),
                block: info.action_block,
                history: info.history,
                direct: loaded.acts().then_some(direct),
            },
            None => NamedKind::Direct(direct),
        };
        let path = home::checkpoint(given)?;
        let capsule = path.is_file().then(|| Capsule::read(&path)).transpose()?;
        let evaluation = capsule.and_then(|capsule| capsule.evaluation);
        let recorded = evaluation.as_ref().map(EvaluationRecord::read).transpose()?;
        let env = info.dataset_info.env.map(|env| (env, path));
        Ok(Self { name, kind, env, image: info.image_size, recorded })
    }

    /// Returns the requests: one policy, or one per solver. A capsule plans as in its evaluation if no option of planning
    /// is given.
    ///
    /// # Errors
    /// When a solver, a setting, the objective or the score is unknown.
    pub fn requests(self, env: &EnvChoice, planner: &PlannerArgs) -> Result<Vec<PolicyRequest>> {
        let name = self.name;
        let (model, block, history) = match self.kind {
            NamedKind::Direct(kind) => return Ok(vec![PolicyRequest { name, kind }]),
            NamedKind::Checkpoint { direct: Some(kind), .. } if planner.solvers.is_empty() => {
                return Ok(vec![PolicyRequest { name, kind }]);
            }
            NamedKind::Simulator => {
                parse_score(&planner.score)?;
                (Model::Simulator { score: planner.score.clone() }, planner.action_block, 1)
            }
            NamedKind::Checkpoint { given, block, history, .. } => {
                let recorded = self.recorded.filter(|_| !planner.is_given());
                if let Some(kind) = recorded.and_then(|recorded| recorded.policy(&given)) {
                    return Ok(vec![PolicyRequest { name, kind }]);
                }
                (Model::Checkpoint(given), block, history)
            }
        };
        // With several solvers, each name contains the solver's text from the command line.
        let given = &planner.solvers;
        let requests = planner.solvers(env)?.into_iter().enumerate().map(|(i, solver)| {
            let name = if given.len() > 1 { format!("{name} ({})", given[i]) } else { name.clone() };
            let kind = planner.plan(model.clone(), solver, block, history)?;
            Ok(PolicyRequest { name, kind })
        });
        requests.collect()
    }
}
