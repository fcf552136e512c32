//! The arms of an autopsy: a planning policy with some parts of its planning replaced ([`Ingredient`]).
//!
//! An autopsy is a study: its cells are the run that selects the failures and, for each set of ingredients and each planning
//! seed, the policy with these ingredients on the same starts. [`swm_core::results::Autopsy`] is what their results show.

use serde_json::{Value, json};
use swm_core::results::{ArmRuns, Autopsy, Counting, Ingredient, game, letters, members};
use swm_core::run::Control;
use swm_core::{Error, Key, Result, Results};
use swm_eval::{
    Cell, Choice, EndCost, EvalRequest, Model, PolicyKind, PolicyRequest, Resolver, RunOptions, StartsRequest, Study,
    StudyFolder, frame_strip,
};
use swm_plan::MpcConfig;

/// By how much a search is larger.
pub const SEARCH: u64 = 10;

/// The probe that reads states from latents: the dataset that it is fitted on, and the columns.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProbeSource {
    /// The dataset: a path or a name.
    pub dataset: String,
    /// The columns that the probe reads.
    pub columns: Vec<String>,
}

/// An autopsy to run.
pub struct Plan {
    /// The selection first, then one cell for each arm and planning seed.
    pub study: Study,
    /// The ingredients that the policy can be given.
    pub ingredients: Vec<Ingredient>,
    /// For each arm, its ingredients and the cells of its runs.
    pub arms: Vec<(Vec<Ingredient>, Vec<Cell>)>,
    /// The probe, if it is an ingredient.
    pub probe: Option<ProbeSource>,
}

impl Plan {
    /// The autopsy of the only cell of a study, whose policy plans in a trained world model. Ingredients that change nothing
    /// about the policy are left out; the distance needs the true dynamics, and the probe distance needs a probe.
    ///
    /// # Errors
    /// When the policy does not plan in a trained world model, arms would play different starts, there are too few planning
    /// seeds, or no ingredient is left.
    pub fn new(
        base: Study,
        ingredients: &[Ingredient],
        planning_seeds: usize,
        probe: Option<ProbeSource>,
    ) -> Result<Self> {
        let (cell, policy) = only(&base)?;
        if !(Autopsy::MIN_SEEDS..=Study::MAX_CELLS / 64).contains(&planning_seeds) {
            let fix = format!("give {} to {}", Autopsy::MIN_SEEDS, Study::MAX_CELLS / 64);
            return Err(Error::config("planning seeds of an autopsy", planning_seeds.to_string(), fix));
        }
        if matches!(cell.request.counting, Counting::Compat { .. }) && cell.request.starts == StartsRequest::Episodic {
            let problem =
                "compat counting of drawn starts counts the episodes that finish first, which differ between arms";
            return Err(Error::config("an autopsy", problem, "use protocol=strict, or take starts from a dataset"));
        }
        if ingredients.contains(&Ingredient::Distance) && !ingredients.contains(&Ingredient::Dynamics) {
            let problem = "the true distance is that of simulated states, so it comes after the true dynamics";
            return Err(Error::config("ingredients of an autopsy", problem, "add D, or leave out E"));
        }
        let mut changing = vec![];
        for ingredient in Ingredient::ALL.into_iter().filter(|ingredient| ingredients.contains(ingredient)) {
            if with(&policy.kind, &[ingredient], probe.as_ref())? != policy.kind {
                changing.push(ingredient);
            }
        }
        if changing.is_empty() {
            let fix = "name at least one of S, R, D, C and E; R changes a policy that executes several steps of a plan";
            return Err(Error::config("ingredients of an autopsy", "none changes the policy", fix));
        }
        let mut arms = vec![];
        for coalition in game(&changing).coalitions() {
            let set = members(&changing, coalition);
            let kind = with(&policy.kind, &set, probe.as_ref())?;
            let name =
                if set.is_empty() { policy.name.clone() } else { format!("{} + {}", policy.name, letters(&set)) };
            let cell = |seed: usize| {
                let mut cell = cell.clone();
                let name = format!("{name}, planning seed {seed}");
                cell.request.policies = vec![PolicyRequest { name, kind: kind.clone() }];
                cell.request.planning_seed = Some(seed as u64);
                cell
            };
            arms.push((set, (1..=planning_seeds).map(cell).collect::<Vec<_>>()));
        }
        let cells = std::iter::once(cell.clone()).chain(arms.iter().flat_map(|(_, cells)| cells.clone())).collect();
        let study = Study { cells, ..base };
        study.check()?;
        Ok(Self { study, ingredients: changing, arms, probe })
    }

    /// The request of the policy without ingredients.
    ///
    /// # Errors
    /// Never for an autopsy that [`Plan::new`] made.
    pub fn request(&self) -> Result<&EvalRequest> {
        self.study.cells.first().map(|cell| &cell.request).ok_or_else(not_planned)
    }

    /// What the results in the folder of the study show.
    ///
    /// # Errors
    /// When a cell has no results, or they are damaged.
    pub fn autopsy(&self, folder: &StudyFolder) -> Result<Autopsy> {
        let results = |cell: &Cell| -> Result<Results> {
            folder.results(cell)?.ok_or_else(|| {
                Error::config(format!("the arm '{}'", cell.policy()), "has no results", "run the autopsy again")
            })
        };
        let run = |cell: &Cell| {
            let runs = results(cell)?.runs.into_iter().find(|run| run.policy == cell.policy());
            runs.ok_or_else(|| Error::mismatch("an arm of an autopsy", "results without its policy", cell.policy()))
        };
        let selection = self.study.cells.first().ok_or_else(not_planned)?;
        let arm = |(ingredients, cells): &(Vec<Ingredient>, Vec<Cell>)| {
            Ok(ArmRuns { ingredients: ingredients.clone(), runs: cells.iter().map(run).collect::<Result<_>>()? })
        };
        let arms: Vec<ArmRuns> = self.arms.iter().map(arm).collect::<Result<_>>()?;
        let request = &selection.request;
        Autopsy::of(&run(selection)?, &arms, request.counting, Key::new(request.seed))
    }
}

/// A repaired start as a frame strip.
pub struct Strip {
    /// The index of the start.
    pub start: usize,
    /// The smallest set of ingredients with which it was solved.
    pub set: Vec<Ingredient>,
    /// A PNG file.
    pub png: Vec<u8>,
}

impl Plan {
    /// The most starts with a frame strip.
    pub const STRIPS: usize = 12;
    /// The frames of a frame strip, without the goal.
    pub const FRAMES: usize = 7;

    /// Plays the first failures that ingredients repair again, each with the first of its smallest sets and the first planning seed
    /// that solves it. None without frames.
    ///
    /// # Errors
    /// As [`Plan::autopsy`], and when playing fails.
    pub fn strips(
        &self,
        found: &Autopsy,
        folder: &StudyFolder,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<Vec<Strip>> {
        let mut strips = vec![];
        let repaired = found.repairs.iter().filter_map(|repair| Some((repair.start, repair.sets.first()?)));
        for (start, set) in repaired.filter(|(_, set)| !set.is_empty()).take(Self::STRIPS) {
            let cells = self
                .arms
                .iter()
                .find(|(ingredients, _)| ingredients == set)
                .map_or(&[][..], |(_, cells)| cells.as_slice());
            for cell in cells {
                let results = folder.results(cell)?;
                let mut runs = results.iter().flat_map(|results| &results.runs);
                let run = runs.find(|run| run.policy == cell.policy());
                if !run.and_then(|run| run.episodes.get(start)).is_some_and(|episode| episode.success) {
                    continue;
                }
                let png = frame_strip(&cell.request, start, Self::FRAMES, resolver, options, control)?;
                strips.extend(png.map(|png| Strip { start, set: set.clone(), png }));
                break;
            }
        }
        Ok(strips)
    }
}

fn not_planned() -> Error {
    Error::config("an autopsy", "its study has no cell", "make it with Plan::new")
}

/// The only cell of a study, and its policy.
fn only(study: &Study) -> Result<(&Cell, &PolicyRequest)> {
    if let [cell] = &study.cells[..]
        && let [policy] = &cell.request.policies[..]
    {
        return Ok((cell, policy));
    }
    Err(Error::mismatch("an autopsy", format!("{} evaluations", study.cells.len()), "one evaluation of one policy"))
}

/// The policy with some ingredients; `probe` is what the ingredient of this name uses.
///
/// # Errors
/// When it does not plan in a trained world model, its search cannot be larger, or there is no probe.
pub fn with(kind: &PolicyKind, set: &[Ingredient], probe: Option<&ProbeSource>) -> Result<PolicyKind> {
    let PolicyKind::Plan { model: Model::Checkpoint(checkpoint), solver, mpc, objective } = kind else {
        let problem = "the policy does not plan in a trained world model";
        return Err(Error::config(
            "an autopsy",
            problem,
            "give a checkpoint of a world model, such as a LeWM or a PLDM",
        ));
    };
    let has = |ingredient| set.contains(&ingredient);
    let true_dynamics = |cost| Model::TrueDynamics { checkpoint: checkpoint.clone(), cost };
    let probed = |true_dynamics| {
        let Some(ProbeSource { dataset, columns }) = probe else {
            let fix = "name a dataset to fit the probe on, with --probe-data";
            return Err(Error::config(
                "ingredients of an autopsy",
                "C needs a probe, and there is no dataset for it",
                fix,
            ));
        };
        let (checkpoint, dataset, columns) = (checkpoint.clone(), dataset.clone(), columns.clone());
        Ok(Model::Probe { checkpoint, dataset, columns, true_dynamics })
    };
    let model = match (has(Ingredient::Dynamics), has(Ingredient::Probe), has(Ingredient::Distance)) {
        (false, false, false) => Model::Checkpoint(checkpoint.clone()),
        (true, false, false) => true_dynamics(EndCost::Latent),
        (dynamics, true, false) => probed(dynamics)?,
        (_, _, true) => true_dynamics(EndCost::Success),
    };
    let solver = if has(Ingredient::Search) { larger(solver)? } else { solver.clone() };
    let mut mpc = mpc.clone();
    if has(Ingredient::Replanning) {
        mpc["receding_horizon"] = json!(1);
    }
    Ok(PolicyKind::Plan { model, solver, mpc, objective: objective.clone() })
}

/// A solver with [`SEARCH`] times as many candidates, or iterations if it has no candidates.
fn larger(solver: &Choice) -> Result<Choice> {
    let mut settings = solver.settings.clone();
    for name in ["samples", "iterations"] {
        if let Some(count) = settings.get(name).and_then(Value::as_u64) {
            settings[name] = json!(count.saturating_mul(SEARCH));
            return Ok(Choice { id: solver.id.clone(), settings });
        }
    }
    let fix = "leave out S";
    Err(Error::config(format!("the solver '{}'", solver.id), "has neither samples nor iterations to multiply", fix))
}

/// The most plans that an episode of a policy makes; `limit` is the time limit in steps.
pub fn plans(kind: &PolicyKind, limit: usize) -> usize {
    let PolicyKind::Plan { mpc, .. } = kind else { return 0 };
    let mpc: MpcConfig = serde_json::from_value(mpc.clone()).unwrap_or_default();
    limit.div_ceil((mpc.receding_horizon * mpc.action_block).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;
    use Ingredient::{Distance, Dynamics, Probe, Replanning, Search};

    fn kind() -> PolicyKind {
        PolicyKind::Plan {
            model: Model::Checkpoint("rooms".to_owned()),
            solver: Choice { id: "cem".to_owned(), settings: json!({"samples": 30, "iterations": 4, "elites": 5}) },
            mpc: json!({"horizon": 4, "receding_horizon": 2, "action_block": 5}),
            objective: Value::Null,
        }
    }

    #[test]
    fn ingredients_change_their_part_of_a_policy_only() {
        let with = |set: &[Ingredient]| with(&kind(), set, None).expect("an arm");
        assert_eq!(with(&[]), kind());
        let PolicyKind::Plan { model, solver, mpc, .. } = with(&[Search, Replanning]) else { panic!("no plan") };
        assert_eq!(solver.settings, json!({"samples": 300, "iterations": 4, "elites": 5}));
        assert_eq!(mpc, json!({"horizon": 4, "receding_horizon": 1, "action_block": 5}));
        assert_eq!(model, Model::Checkpoint("rooms".to_owned()));
        for (set, cost) in [(&[Dynamics][..], EndCost::Latent), (&[Dynamics, Distance], EndCost::Success)] {
            let PolicyKind::Plan { model, solver, mpc, .. } = with(set) else { panic!("no plan") };
            assert_eq!(model, Model::TrueDynamics { checkpoint: "rooms".to_owned(), cost });
            assert_eq!((solver.settings["samples"].as_u64(), mpc["receding_horizon"].as_u64()), (Some(30), Some(2)));
        }
        let probe = ProbeSource { dataset: "rooms".to_owned(), columns: vec!["state".to_owned()] };
        for (set, expected) in [(&[Probe][..], false), (&[Dynamics, Probe], true)] {
            let PolicyKind::Plan { model: Model::Probe { true_dynamics, columns, .. }, .. } =
                super::with(&kind(), set, Some(&probe)).expect("an arm")
            else {
                panic!("no probe")
            };
            assert_eq!((true_dynamics, columns), (expected, probe.columns.clone()));
        }
        let error = super::with(&kind(), &[Probe], None).expect_err("no probe").to_string();
        assert!(error.contains("--probe-data"), "{error}");
        assert_eq!((plans(&kind(), 50), plans(&with(&[Replanning]), 51)), (5, 11));
        let error = super::with(&PolicyKind::Random, &[], None).expect_err("no planning").to_string();
        assert!(error.contains("a LeWM or a PLDM"), "{error}");
    }
}
