//! Planning by what a probe reads from latents, instead of by their distance: [`StateProbe`], [`ProbedLatents`], [`ProbedCost`].

use super::ridge::{Ridge, mean_and_std};
use super::samples::Spreads;
use super::state::{Network, scores, varying};
use super::targets::Targets;
use super::{Score, StateConfig};
use crate::checks;
use rayon::prelude::*;
use std::sync::Arc;
use swm_core::columns::{GOAL, PIXELS};
use swm_core::run::Control;
use swm_core::{Batch, Candidates, CostModel, Error, Key, Predictor, Result, Schema};
use swm_data::{Part, Reader, Split, StepRange};
use swm_plan::ActionScale;

/// The frames that are read and encoded together, and the candidates that are predicted together.
const BLOCK: usize = 64;
const CHUNK: usize = 1024;

/// A regression of state columns on the latents of a predictor: the better of a linear map and a network.
pub struct StateProbe {
    map: Map,
    /// The standard deviation of each target: states are compared in these units.
    spread: Vec<f32>,
    /// The scores of the linear map and of the network, element by element.
    scores: [Vec<Score>; 2],
}

enum Map {
    Linear(Ridge),
    Network(Box<Network>),
}

impl StateProbe {
    /// Fits both regressions on the training episodes of a dataset, and keeps the one with the higher mean R² on validation
    /// episodes.
    ///
    /// # Errors
    /// When a column is missing or holds images, the predictor cannot encode the rows, all targets are constant, or the run is
    /// stopped.
    pub fn fit(
        predictor: &mut dyn Predictor,
        reader: &dyn Reader,
        config: &StateConfig,
        control: &mut Control<'_>,
    ) -> Result<Self> {
        config.check(1)?;
        let targets = Targets::new(reader, &config.columns, &config.angles)?;
        let (x, y) = tables(predictor, reader, Part::Train, config.frames, (&config.columns, &targets), control)?;
        let (held_x, held_y) =
            tables(predictor, reader, Part::Validation, config.held_out, (&config.columns, &targets), control)?;
        let rows = y.len() / targets.list.len();
        let linear = Ridge::fit(&x, &y, rows, config.ridge, control)?;
        let key = Key::new(config.seed).with("probe");
        let network = Network::fit((&x, &y, rows), config, key, control)?;
        let score = |predicted: &[f32]| scores(&targets.list, predicted, &held_y);
        let scores = [score(&linear.predict(&held_x)), score(&network.predict(&held_x))];
        let mean = |scores: &[Score]| {
            let known: Vec<f64> = scores.iter().filter_map(|score| score.r2).collect();
            known.iter().sum::<f64>() / known.len().max(1) as f64
        };
        let map =
            if mean(&scores[1]) > mean(&scores[0]) { Map::Network(Box::new(network)) } else { Map::Linear(linear) };
        let (_, std) = mean_and_std(&y, rows);
        let varies = varying(&targets.list, &std);
        let unit =
            |(std, varies): (&f64, bool)| if varies { (*std as f32).max(f32::MIN_POSITIVE) } else { f32::INFINITY };
        let spread: Vec<f32> = std.iter().zip(varies).map(unit).collect();
        if spread.iter().all(|spread| spread.is_infinite()) {
            let fix = "name columns that vary, or collect episodes that differ";
            return Err(Error::config("the columns of a probe", "all of them are constant", fix));
        }
        Ok(Self { map, spread, scores })
    }

    /// The number of targets.
    pub fn dim(&self) -> usize {
        self.spread.len()
    }

    /// The scores of the linear map and of the network.
    pub fn scores(&self) -> &[Vec<Score>; 2] {
        &self.scores
    }

    /// Reads states, in units of their standard deviations; a constant element is 0.
    ///
    /// # Shapes
    /// Maps `[rows, latent]` to `[rows, dim]`.
    pub fn read(&self, latents: &[f32]) -> Vec<f32> {
        let mut states = match &self.map {
            Map::Linear(ridge) => ridge.predict(latents),
            Map::Network(network) => network.predict(latents),
        };
        states.chunks_exact_mut(self.spread.len()).for_each(|state| {
            state.iter_mut().zip(&self.spread).for_each(|(value, spread)| *value /= spread);
        });
        states
    }
}

/// The latents and the targets of a part of a dataset: every n-th row, those left out whose latents or targets are not finite.
fn tables(
    predictor: &mut dyn Predictor,
    reader: &dyn Reader,
    part: Part,
    frames: usize,
    (columns, targets): (&[String], &Targets),
    control: &mut Control<'_>,
) -> Result<(Vec<f32>, Vec<f32>)> {
    let chosen = Split::default().episodes(reader, part)?;
    let rows = chosen.iter().flat_map(|&episode| (0..reader.episodes()[episode].length).map(move |row| (episode, row)));
    let all: Vec<(usize, usize)> = rows.collect();
    let every = all.len().div_ceil(frames).max(1);
    let ranges: Vec<StepRange> =
        all.into_iter().step_by(every).map(|(episode, row)| StepRange::new(episode, row, 1)).collect();
    let mut names = predictor.columns();
    names.extend(columns.iter().filter(|name| !predictor.columns().contains(name)).cloned());
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let (mut x, mut y) = (vec![], vec![]);
    let mut spreads = Spreads::new(columns);
    for ranges in ranges.chunks(BLOCK) {
        control.check()?;
        let batch = reader.read(&names, ranges)?;
        let mut latents = vec![0.0; batch.rows() * predictor.latent_dim()];
        predictor.encode(&batch, &mut latents)?;
        spreads.add(&batch)?;
        let values: Vec<Vec<f32>> = columns.iter().map(|name| batch.to_f32(name)).collect::<Result<_>>()?;
        let width = |values: &Vec<f32>| values.len() / batch.rows();
        let row = |row: usize| values.iter().flat_map(move |values| &values[row * width(values)..][..width(values)]);
        let table: Vec<f32> = (0..batch.rows()).flat_map(|i| row(i).copied().collect::<Vec<_>>()).collect();
        let table = targets.of(&table, targets.width, 0);
        for (latent, target) in latents.chunks_exact(predictor.latent_dim()).zip(table.chunks_exact(targets.list.len()))
        {
            if latent.iter().chain(target).all(|value| value.is_finite()) {
                x.extend_from_slice(latent);
                y.extend_from_slice(target);
            }
        }
    }
    if part == Part::Train {
        spreads.check()?;
    }
    if y.len() < 2 * targets.list.len() {
        let problem = format!("fewer than two of its rows have finite values in {}", names.join(", "));
        return Err(Error::config(format!("the {part} split"), problem, "choose other columns, or a larger dataset"));
    }
    Ok((x, y))
}

/// A predictor whose latents are the states that a probe reads. It encodes only: predictions stay in the latents of the model.
pub struct ProbedLatents {
    /// The model.
    pub model: Box<dyn Predictor>,
    /// The probe of its latents.
    pub probe: Arc<StateProbe>,
}

impl Predictor for ProbedLatents {
    fn frameskip(&self) -> usize {
        self.model.frameskip()
    }

    fn columns(&self) -> Vec<String> {
        self.model.columns()
    }

    fn latent_dim(&self) -> usize {
        self.probe.dim()
    }

    fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> Result<()> {
        let mut of_model = vec![0.0; rows.rows() * self.model.latent_dim()];
        self.model.encode(rows, &mut of_model)?;
        latents.copy_from_slice(&self.probe.read(&of_model));
        Ok(())
    }

    fn rollout(&mut self, _start: &[f32], _actions: &[f32], _horizon: usize, _latents: &mut [f32]) -> Result<()> {
        Err(Error::config("a probe", "states that are read from latents cannot be predicted from", "use ProbedCost"))
    }
}

/// The squared distance between the states that a probe reads from the predicted latent at the end of a plan, or from the closest
/// one, and from the latent of the goal. Predictions begin at the latent of one observation.
pub struct ProbedCost {
    model: Box<dyn Predictor>,
    probe: Arc<StateProbe>,
    scale: ActionScale,
    /// Whether the closest predicted state is compared, not the last one.
    closest: bool,
    /// The latents of the observations, and the states of the goals, of all observed environments.
    starts: Vec<f32>,
    goals: Vec<f32>,
}

impl ProbedCost {
    /// The cost of a model; `scale` maps its actions to those of the environment, and `block` is the number of actions of a model
    /// step.
    ///
    /// # Errors
    /// When a model step has another number of actions than the model's.
    pub fn new(model: Box<dyn Predictor>, probe: Arc<StateProbe>, scale: ActionScale, block: usize) -> Result<Self> {
        if model.frameskip() != block {
            let given = format!("{block} actions for a model step");
            return Err(Error::mismatch("planning by a probe", given, format!("{}, as the model", model.frameskip())));
        }
        Ok(Self { model, probe, scale, closest: false, starts: vec![], goals: vec![] })
    }

    /// The latents of the observations, or of the goals, of some environments.
    fn encode(&mut self, infos: &Batch, envs: &[usize], is_goal: bool) -> Result<Vec<f32>> {
        let names = self.model.columns();
        let from = |name: &String| match (is_goal, name.as_str()) {
            (false, _) => name.clone(),
            (true, PIXELS) => GOAL.to_owned(),
            (true, _) => format!("goal_{name}"),
        };
        let columns: Vec<usize> = names.iter().map(|name| infos.schema().index(&from(name))).collect::<Result<_>>()?;
        let specs = columns.iter().zip(&names).map(|(index, name)| swm_core::ColumnSpec {
            name: name.clone(),
            ..infos.schema().columns()[*index].clone()
        });
        let mut rows = Batch::zeros(&Schema::new(specs.collect::<Vec<_>>())?, envs.len());
        for (row, &env) in envs.iter().enumerate() {
            for (to, &from) in columns.iter().enumerate() {
                rows.row_mut(row).bytes(to).copy_from_slice(infos.row(env).bytes(from));
            }
        }
        let mut latents = vec![0.0; envs.len() * self.model.latent_dim()];
        self.model.encode(&rows, &mut latents)?;
        Ok(latents)
    }
}

impl CostModel for ProbedCost {
    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.starts = self.encode(infos, envs, false)?;
        let goals = self.encode(infos, envs, true)?;
        self.goals = self.probe.read(&goals);
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        let (latent, state, block) = (self.model.latent_dim(), self.probe.dim(), self.model.frameskip());
        let sizes = [self.starts.len() / latent.max(1), block * self.scale.dim()];
        checks::candidate_sizes("costs by a probe", &candidates, costs, sizes)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let len = horizon * dim;
        let compared = if self.closest { horizon } else { 1 };
        for (chunk, (actions, costs)) in actions.chunks(CHUNK * len).zip(costs.chunks_mut(CHUNK)).enumerate() {
            let env_of = |i: usize| (chunk * CHUNK + i) / samples;
            let mut of_env = vec![0.0; actions.len()];
            let one = self.scale.dim();
            let pairs = actions.par_chunks_exact(one).zip(of_env.par_chunks_exact_mut(one));
            pairs.for_each(|(planned, action)| self.scale.to_env(planned, action));
            let starts: Vec<f32> =
                (0..costs.len()).flat_map(|i| &self.starts[env_of(i) * latent..][..latent]).copied().collect();
            let mut predicted = vec![0.0; costs.len() * horizon * latent];
            self.model.rollout(&starts, &of_env, horizon, &mut predicted)?;
            let ends: Vec<f32> = predicted
                .chunks_exact(horizon * latent)
                .flat_map(|path| &path[(horizon - compared) * latent..])
                .copied()
                .collect();
            let states = self.probe.read(&ends);
            for (i, (cost, ends)) in costs.iter_mut().zip(states.chunks_exact(compared * state)).enumerate() {
                let goal = &self.goals[env_of(i) * state..][..state];
                let distance = |end: &[f32]| end.iter().zip(goal).map(|(a, b)| (a - b).powi(2)).sum();
                *cost = ends.chunks_exact(state).map(distance).fold(f32::NAN, f32::min);
            }
        }
        Ok(())
    }

    fn compare_closest(&mut self) -> bool {
        self.closest = true;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::{ColumnSpec, DType};

    /// A model of a point on a line, whose latent is (10 x, 3, x²); an action moves the point.
    struct Line;

    impl Predictor for Line {
        fn frameskip(&self) -> usize {
            1
        }

        fn columns(&self) -> Vec<String> {
            vec!["state".to_owned()]
        }

        fn latent_dim(&self) -> usize {
            3
        }

        fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> Result<()> {
            for (x, latent) in rows.to_f32("state")?.into_iter().zip(latents.chunks_exact_mut(3)) {
                latent.copy_from_slice(&[10.0 * x, 3.0, x * x]);
            }
            Ok(())
        }

        fn rollout(&mut self, start: &[f32], actions: &[f32], horizon: usize, latents: &mut [f32]) -> Result<()> {
            for (i, start) in start.chunks_exact(3).enumerate() {
                let mut x = start[0] / 10.0;
                for step in 0..horizon {
                    x += actions[i * horizon + step];
                    latents[(i * horizon + step) * 3..][..3].copy_from_slice(&[10.0 * x, 3.0, x * x]);
                }
            }
            Ok(())
        }
    }

    #[test]
    fn plans_are_judged_by_the_state_that_the_probe_reads() {
        // A linear map from latents to x, fitted on points of the line.
        let points: Vec<f32> = (0..50).map(|i| i as f32 / 10.0 - 2.5).collect();
        let latents: Vec<f32> = points.iter().flat_map(|x| [10.0 * x, 3.0, x * x]).collect();
        let ridge = Ridge::fit(&latents, &points, 50, 1e-6, &mut Control::new()).expect("a map");
        let probe = Arc::new(StateProbe { map: Map::Linear(ridge), spread: vec![0.5], scores: [vec![], vec![]] });
        let read = probe.read(&[10.0, 3.0, 1.0]);
        assert!((read[0] - 2.0).abs() < 1e-2, "one, in units of a half: {read:?}");

        let columns = ["state", "goal_state"].map(|name| ColumnSpec::new(name, DType::Float32, [1]));
        let mut infos = Batch::zeros(&Schema::new(columns).expect("a schema"), 2);
        infos.get_mut::<f32>("state").expect("a column").copy_from_slice(&[0.0, 1.0]);
        infos.get_mut::<f32>("goal_state").expect("a column").copy_from_slice(&[1.0, 1.0]);
        let scale = ActionScale::identity(1);
        let mut cost = ProbedCost::new(Box::new(Line), Arc::clone(&probe), scale.clone(), 1).expect("a cost");
        cost.observe(&infos, &[0, 1]).expect("observing");
        let actions = [0.5, 0.5, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0];
        let candidates = Candidates { actions: &actions, envs: 2, samples: 2, horizon: 2, dim: 1 };
        let mut costs = [0.0; 4];
        cost.cost(candidates, &mut costs).expect("costs");
        for (cost, expected) in costs.iter().zip([0.0, 4.0, 4.0, 0.0]) {
            assert!((cost - expected).abs() < 0.05, "{costs:?}");
        }
        assert!(cost.compare_closest());
        // Half of the way, and back; there and beyond; away from the goal; at the goal, then beyond.
        let actions = [0.5, -0.5, 1.0, 0.5, 0.5, 0.5, 0.0, 0.5];
        cost.cost(Candidates { actions: &actions, ..candidates }, &mut costs).expect("costs");
        for (cost, expected) in costs.iter().zip([1.0, 0.0, 1.0, 0.0]) {
            assert!((cost - expected).abs() < 0.05, "{costs:?}");
        }
        assert!(ProbedCost::new(Box::new(Line), Arc::clone(&probe), scale, 2).is_err());
        let mut probed = ProbedLatents { model: Box::new(Line), probe };
        let mut states = [0.0; 2];
        probed.encode(&infos, &mut states).expect("states");
        assert!((states[1] - 2.0).abs() < 1e-2 && probed.latent_dim() == 1, "{states:?}");
    }
}
