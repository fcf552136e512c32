//! Tests of the true dynamics with the cost of a world model: a model encodes what simulated candidates lead to.

use rand::Rng as _;
use std::collections::BTreeSet;
use swm_core::columns::PIXELS;
use swm_core::pool::{Reset, threads};
use swm_core::{
    Action, Batch, Candidates, CostModel, EnvPool, FrameMut, Key, Predictor, ResetOptions, Result, VariationRequest,
};
use swm_envs::two_room;
use swm_plan::{ActionScale, SimulatedLatents};

const HORIZON: usize = 3;
const BLOCK: usize = 2;
const SIDE: usize = 32;

/// A model whose latent is the position of the agent, or the mean colour of the frame; its dynamics must not be used.
struct Encoder {
    column: &'static str,
}

impl Encoder {
    fn latent(&self, row: swm_core::RowRef<'_>) -> Result<[f32; 2]> {
        if self.column != PIXELS {
            return Ok(*row.get::<f32>(self.column)?.first_chunk().expect("two values"));
        }
        let values = row.get::<u8>(PIXELS)?;
        let mean = |channel: usize| {
            let channel = values.iter().skip(channel).step_by(3).enumerate();
            channel.map(|(i, value)| i as f32 * f32::from(*value)).sum::<f32>() / 1e5
        };
        Ok([mean(0), mean(1)])
    }
}

impl Predictor for Encoder {
    fn frameskip(&self) -> usize {
        BLOCK
    }

    fn columns(&self) -> Vec<String> {
        vec![self.column.to_owned()]
    }

    fn latent_dim(&self) -> usize {
        2
    }

    fn encode(&mut self, rows: &Batch, latents: &mut [f32]) -> Result<()> {
        for (row, latent) in latents.chunks_exact_mut(2).enumerate() {
            latent.copy_from_slice(&self.latent(rows.row(row))?);
        }
        Ok(())
    }

    fn rollout(&mut self, _: &[f32], _: &[f32], _: usize, _: &mut [f32]) -> Result<()> {
        panic!("the dynamics of the model are not used");
    }
}

/// Environments with the goal drawn, so that frames differ in both channels.
fn pool(envs: usize) -> EnvPool {
    let envs = (0..envs).map(|_| two_room::ENTRY.env().expect("creating the environment")).collect();
    let mut pool = EnvPool::new(envs, Some((SIDE, SIDE)), None, threads(2).expect("creating the thread pool"))
        .expect("creating the environment pool");
    let reset = |slot| Reset {
        slot,
        seed: slot as u64,
        options: ResetOptions { variation: VariationRequest::default(), ..ResetOptions::default() },
    };
    pool.reset(&(0..pool.len()).map(reset).collect::<Vec<_>>()).expect("resetting the environments");
    pool
}

/// The cost after it has observed these slots.
fn model(pool: &EnvPool, slots: &[usize], column: &'static str) -> SimulatedLatents {
    let (scale, encoder) = (ActionScale { mean: vec![0.1, 0.0], std: vec![0.5, 2.0] }, Box::new(Encoder { column }));
    let mut model = SimulatedLatents::new(|| two_room::ENTRY.env(), scale, BLOCK, encoder).expect("creating the cost");
    slots.iter().for_each(|&slot| model.observe_env(slot, pool.env(slot)).expect("observing the environment"));
    model.observe(pool.infos(), slots).expect("observing the environments");
    model
}

fn costs(model: &mut SimulatedLatents, actions: &[f32], envs: usize) -> Vec<f32> {
    let samples = actions.len() / (envs * HORIZON * BLOCK * 2);
    let mut costs = vec![f32::NAN; envs * samples];
    let candidates = Candidates { actions, envs, samples, horizon: HORIZON, dim: BLOCK * 2 };
    model.cost(candidates, &mut costs).expect("the model computes costs");
    costs
}

#[test]
fn costs_are_distances_of_the_latents_that_candidates_lead_to() {
    let (pool, mut rng) = (pool(2), Key::new(1).rng());
    let actions: Vec<f32> = (0..6 * HORIZON * BLOCK * 2).map(|_| rng.random_range(-1.0..1.0)).collect();
    for column in ["state", PIXELS] {
        let costs = costs(&mut model(&pool, &[1], column), &actions, 1);
        for (candidate, cost) in actions.chunks_exact(HORIZON * BLOCK * 2).zip(&costs) {
            let mut env = two_room::ENTRY.env().expect("creating the environment");
            env.restore(&pool.env(1).snapshot()).expect("restoring the snapshot");
            for planned in candidate.chunks_exact(2) {
                let action = [(planned[0] * 0.5 + 0.1).clamp(-1.0, 1.0), (planned[1] * 2.0).clamp(-1.0, 1.0)];
                env.step(Action::Continuous(&action)).expect("stepping the environment");
            }
            let mut row = Batch::zeros(pool.infos().schema(), 2);
            env.observe(&mut row.row_mut(0));
            let frame = row.schema().index(PIXELS).expect("frames");
            env.render(FrameMut::new(SIDE, SIDE, row.row_mut(0).at::<u8>(frame))).expect("rendering the frame");
            env.render_goal(FrameMut::new(SIDE, SIDE, row.row_mut(1).at::<u8>(frame))).expect("rendering the goal");
            let state = row.schema().index("state").expect("the state");
            let goal = pool.infos().row(1).get::<f32>("goal_state").expect("the goal's state").to_vec();
            row.row_mut(1).set(state, &goal);
            let encoder = Encoder { column };
            let [end, goal] = [0, 1].map(|i| encoder.latent(row.row(i)).expect("a latent"));
            let expected: f32 = end.iter().zip(goal).map(|(a, b)| (a - b).powi(2)).sum();
            assert_eq!(cost.to_bits(), expected.to_bits(), "{column}");
        }
        let different: BTreeSet<u32> = costs.iter().map(|cost| cost.to_bits()).collect();
        assert!(different.len() > 3, "{column}: {costs:?}");
    }
}

#[test]
fn closest_latent_is_the_last_one_of_the_cheapest_shorter_plan() {
    let (pool, mut rng) = (pool(2), Key::new(3).rng());
    let (samples, dim) = (600, BLOCK * 2);
    let all: Vec<f32> = (0..2 * samples * HORIZON * dim).map(|_| rng.random_range(-1.0..1.0)).collect();
    let cost = |horizon: usize, closest: bool| {
        let mut model = model(&pool, &[0, 1], "state");
        assert!(!closest || model.compare_closest());
        let actions: Vec<f32> =
            all.chunks_exact(HORIZON * dim).flat_map(|candidate| &candidate[..horizon * dim]).copied().collect();
        let mut costs = vec![f32::NAN; 2 * samples];
        let candidates = Candidates { actions: &actions, envs: 2, samples, horizon, dim };
        model.cost(candidates, &mut costs).expect("the model computes costs");
        costs
    };
    let shorter: Vec<Vec<f32>> = (1..=HORIZON).map(|horizon| cost(horizon, false)).collect();
    let least = |i: usize| shorter.iter().map(|costs| costs[i]).fold(f32::INFINITY, f32::min);
    assert_eq!(cost(HORIZON, true), (0..2 * samples).map(least).collect::<Vec<_>>());
    assert!(
        shorter.iter().all(|costs| (0..2 * samples).any(|i| costs[i] > least(i))),
        "one step is always the closest"
    );
}

#[test]
fn costs_do_not_depend_on_other_environments_threads_or_chunks() {
    let (pool, mut rng) = (pool(3), Key::new(2).rng());
    // More candidates than are held at once.
    let own = 700 * HORIZON * BLOCK * 2;
    let all: Vec<f32> = (0..3 * own).map(|_| rng.random_range(-1.0..1.0)).collect();
    let run = |threads: usize, slots: &[usize]| {
        let workers = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("creating the thread pool");
        let actions: Vec<f32> = slots.iter().flat_map(|&slot| &all[slot * own..][..own]).copied().collect();
        let mut model = model(&pool, slots, "state");
        let costs = workers.install(|| costs(&mut model, &actions, slots.len()));
        costs.chunks(700).map(<[f32]>::to_vec).collect::<Vec<_>>()
    };
    let together = run(1, &[0, 1, 2]);
    assert_eq!(run(2, &[0, 1, 2]), together);
    assert_eq!(run(2, &[2, 0]), [together[2].clone(), together[0].clone()]);
}

#[test]
fn columns_without_a_goal_are_errors() {
    let pool = pool(1);
    for (column, part) in [("distance_to_target", "goal_distance_to_target"), ("depth", "'depth', which is no column")]
    {
        let (scale, encoder) = (ActionScale::identity(2), Box::new(Encoder { column }));
        let mut model =
            SimulatedLatents::new(|| two_room::ENTRY.env(), scale, BLOCK, encoder).expect("creating the cost");
        model.observe_env(0, pool.env(0)).expect("observing the environment");
        let error = model.observe(pool.infos(), &[0]).expect_err("no goal").to_string();
        assert!(error.contains(part), "{error}");
    }
}
