//! [`SimulatedLatents`]: the true dynamics with the cost of a world model.

use super::playback::Playback;
use crate::mpc::ActionScale;
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{Batch, Candidates, ColumnSpec, CostModel, DType, Env, Error, FrameMut, Predictor, Result, Schema};

/// The squared distance between the latent of the observation in which a simulated candidate ends, or of the closest one after a
/// model step, and the latent of the goal. The candidate is played in the environment, and a world model encodes what it leads to:
/// its dynamics are not used. For the closest latent, a candidate is played once for every step, from its start.
pub struct SimulatedLatents {
    playback: Playback,
    model: Box<dyn Predictor>,
    /// The number of the environment's own columns, which are the first of the infos.
    own: usize,
    /// Whether the closest latent is compared, not the last one.
    closest: bool,
    /// The compared observations of candidates: the environment's columns, and frames if the model reads them.
    ends: Option<Batch>,
    /// The latents of the goals of the observed environments, `[envs, latent]`.
    goals: Vec<f32>,
    latents: Vec<f32>,
}

/// The number of observations that are held at once.
const CHUNK: usize = 1024;

impl SimulatedLatents {
    /// Creates the cost of a world model with the dynamics of the environments that `make` creates. `scale` and `action_block`
    /// must be the policy's.
    ///
    /// # Errors
    /// When the scale does not fit the environment, a model step has no action, or `make` fails.
    pub fn new(
        make: impl Fn() -> Result<Box<dyn Env>> + Send + Sync + 'static,
        scale: ActionScale,
        action_block: usize,
        model: Box<dyn Predictor>,
    ) -> Result<Self> {
        let playback = Playback::new(Box::new(make), scale, action_block)?;
        let own = playback.with(|simulator| Ok(simulator.env.spec().columns.len()))?;
        Ok(Self { playback, model, own, closest: false, ends: None, goals: vec![], latents: vec![] })
    }

    /// The columns of the observations: the environment's own, and the frame if the model reads it.
    fn schema(&self, infos: &Schema) -> Result<Schema> {
        let mut columns: Vec<ColumnSpec> = infos.columns()[..self.own].to_vec();
        for name in self.model.columns() {
            if name == PIXELS {
                columns.push(infos.column(PIXELS)?.clone());
            } else if columns.iter().all(|column| column.name != name) {
                let problem = format!("the model reads '{name}', which is no column of the environment");
                return Err(Error::config("true dynamics", problem, "plan with the model's own dynamics"));
            }
        }
        Schema::new(columns)
    }

    /// Writes the latents of the goals. A model encodes the column `goal` as a frame, and `goal_NAME` as the column NAME.
    fn encode_goals(&mut self, infos: &Batch, envs: &[usize], schema: &Schema) -> Result<()> {
        let mut goals = Batch::zeros(schema, envs.len());
        for name in self.model.columns() {
            let of_goal = if name == PIXELS { GOAL.to_owned() } else { format!("goal_{name}") };
            let (from, to) = (infos.schema().index(&of_goal)?, schema.index(&name)?);
            let given = &infos.schema().columns()[from];
            let [given, wanted] = [given, &schema.columns()[to]].map(|column| (column.dtype, column.shape.clone()));
            if given != wanted {
                let describe = |(dtype, shape): (DType, Vec<usize>)| format!("{} {shape:?}", dtype.name());
                return Err(Error::mismatch(format!("the goal '{of_goal}'"), describe(given), describe(wanted)));
            }
            for (row, &env) in envs.iter().enumerate() {
                goals.row_mut(row).bytes(to).copy_from_slice(infos.row(env).bytes(from));
            }
        }
        self.goals.resize(envs.len() * self.model.latent_dim(), 0.0);
        self.model.encode(&goals, &mut self.goals)
    }
}

impl CostModel for SimulatedLatents {
    fn observe_env(&mut self, slot: usize, env: &dyn Env) -> Result<()> {
        self.playback.observe_env(slot, env)
    }

    fn observe(&mut self, infos: &Batch, envs: &[usize]) -> Result<()> {
        self.playback.observe(envs)?;
        let schema = self.schema(infos.schema())?;
        self.encode_goals(infos, envs, &schema)?;
        if self.ends.as_ref().is_none_or(|ends| *ends.schema() != schema) {
            self.ends = Some(Batch::zeros(&schema, 0));
        }
        Ok(())
    }

    fn cost(&mut self, candidates: Candidates<'_>, costs: &mut [f32]) -> Result<()> {
        self.playback.check(&candidates)?;
        let Candidates { actions, samples, horizon, dim, .. } = candidates;
        let compared = if self.closest { horizon } else { 1 };
        let Self { playback, model, ends: Some(ends), goals, latents, .. } = self else { return Ok(()) };
        let (len, latent) = (horizon * dim, model.latent_dim());
        let frame = ends.schema().find(PIXELS).map(|index| (index, ends.schema().columns()[index].shape.clone()));
        let in_chunk = CHUNK.div_ceil(compared);
        let chunks = actions.chunks(in_chunk * len).zip(costs.chunks_mut(in_chunk));
        for (chunk, (actions, costs)) in chunks.enumerate() {
            let rows = costs.len() * compared;
            ends.resize(rows);
            let mut failed: Vec<Option<Error>> = Vec::from_iter((0..rows).map(|_| None));
            ends.par_zip_mut(&mut failed, |row_index, mut row, failed| {
                // A row plays its candidate up to its own step.
                let (i, steps) = (row_index / compared, horizon - compared + 1 + row_index % compared);
                let played = playback.with(|simulator| {
                    simulator.env.restore(playback.start((chunk * in_chunk + i) / samples))?;
                    for planned in actions[i * len..][..steps * dim].chunks_exact(playback.width()) {
                        playback.step(simulator, planned)?;
                    }
                    simulator.env.observe(&mut row);
                    match &frame {
                        Some((index, shape)) => {
                            simulator.env.render(FrameMut::new(shape[1], shape[0], row.at::<u8>(*index)))
                        }
                        None => Ok(()),
                    }
                });
                *failed = played.err();
            });
            if let Some(error) = failed.into_iter().flatten().next() {
                return Err(error);
            }
            latents.resize(rows * latent, 0.0);
            model.encode(ends, latents)?;
            for (i, (cost, ends)) in costs.iter_mut().zip(latents.chunks_exact(compared * latent)).enumerate() {
                let goal = &goals[(chunk * in_chunk + i) / samples * latent..][..latent];
                let distance = |end: &[f32]| end.iter().zip(goal).map(|(a, b)| (a - b).powi(2)).sum();
                *cost = ends.chunks_exact(latent).map(distance).fold(f32::NAN, f32::min);
            }
        }
        Ok(())
    }

    fn compare_closest(&mut self) -> bool {
        self.closest = true;
        true
    }
}
