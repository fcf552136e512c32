//! Tests of the simulator as a cost model: it steps each candidate with the actions that the policy would execute.

use rand::Rng as _;
use swm_core::pool::{Reset, threads};
use swm_core::{Action, Candidates, CostModel, EnvEntry, EnvPool, Key, ResetOptions, Rng, Space};
use swm_envs::{push_t, two_room};
use swm_plan::{ActionScale, Score, SimulatorCost};

const HORIZON: usize = 3;
const BLOCK: usize = 2;

fn pool(entry: &EnvEntry, envs: usize) -> EnvPool {
    let envs = (0..envs).map(|_| entry.env().expect("creating the environment")).collect();
    let mut pool = EnvPool::new(envs, None, None, threads(1).expect("creating the thread pool"))
        .expect("creating the environment pool");
    let resets = (0..pool.len()).map(|slot| Reset { slot, seed: slot as u64, options: ResetOptions::default() });
    pool.reset(&resets.collect::<Vec<_>>()).expect("resetting the environment");
    pool
}

/// A simulator that has observed these slots.
fn simulator(entry: &EnvEntry, pool: &EnvPool, slots: &[usize], score: Score) -> SimulatorCost {
    let mut simulator = SimulatorCost::new(
        {
            let entry = *entry;
            move || entry.env()
        },
        ActionScale::unscaled(pool.spec()),
        BLOCK,
        score,
    )
    .expect("creating the simulator");
    slots.iter().for_each(|&slot| simulator.observe_env(slot, pool.env(slot)).expect("observing the environment"));
    simulator.observe(pool.infos(), slots).expect("observing the environments");
    simulator
}

fn costs(simulator: &mut SimulatorCost, actions: &[f32], envs: usize, samples: usize) -> Vec<f32> {
    let mut costs = vec![f32::NAN; envs * samples];
    let dim = actions.len() / (envs * samples * HORIZON);
    simulator
        .cost(Candidates { actions, envs, samples, horizon: HORIZON, dim }, &mut costs)
        .expect("the model computes costs");
    costs
}

fn actions(rng: &mut Rng, n: usize) -> Vec<f32> {
    (0..n).map(|_| rng.random_range(-1.5..1.5)).collect()
}

#[test]
fn costs_equal_distances_and_rewards_in_the_environment() {
    for entry in [&two_room::ENTRY, &push_t::ENTRY] {
        let samples = 5;
        let actions = actions(&mut Key::new(1).rng(), samples * HORIZON * BLOCK * 2);
        let pool = pool(entry, 2);
        for score in [Score::Terminal, Score::Running, Score::Reward] {
            let costs = costs(&mut simulator(entry, &pool, &[1], score), &actions, 1, samples);
            for (candidate, cost) in actions.chunks_exact(HORIZON * BLOCK * 2).zip(costs) {
                let mut environment = entry.env().expect("creating the environment");
                environment.restore(&pool.env(1).snapshot()).expect("restoring the snapshot");
                let (mut distances, mut rewards) = (vec![], 0.0);
                for action in candidate.chunks_exact(2) {
                    let action = [action[0].clamp(-1.0, 1.0), action[1].clamp(-1.0, 1.0)];
                    let outcome = environment.step(Action::Continuous(&action)).expect("stepping the environment");
                    assert!(!outcome.terminated && !outcome.truncated, "a random plan is not the end");
                    distances.push(environment.goal_distance());
                    rewards += outcome.reward;
                }
                let expected = match score {
                    Score::Running => distances.iter().sum(),
                    Score::Reward => 0.0 - rewards,
                    _ => distances[distances.len() - 1],
                };
                assert_eq!(cost.to_bits(), (expected as f32).to_bits(), "{}, {score:?}", entry.id);
            }
        }
    }
}

#[test]
fn reach_score_counts_remaining_steps_or_the_final_distance() {
    let entry = &two_room::ENTRY;
    let mut pool = pool(entry, 1);
    // The goal is within 16 pixels after 3 steps of 5 pixels to the right.
    pool.restart(&[0], |_, env| {
        let options = ResetOptions {
            state: Some(vec![30.0, 100.0]),
            goal_state: Some(vec![60.0, 100.0]),
            ..ResetOptions::default()
        };
        env.reset(0, &options)
    })
    .expect("resetting the environment");
    let walk = |steps: usize| (0..6).flat_map(move |t| [if t < steps { 1.0 } else { 0.0 }, 0.0]);
    let actions: Vec<f32> = walk(3).chain(walk(2)).chain(walk(6)).collect();
    let costs = costs(&mut simulator(entry, &pool, &[0], Score::Reach), &actions, 1, 3);
    assert_eq!(
        costs,
        [-0.5, 20.0, -0.5],
        "3 of 6 steps remain; the goal is 20 pixels away; later steps change nothing"
    );
}

#[test]
fn reward_score_ends_with_the_episode() {
    let entry = &two_room::ENTRY;
    let mut pool = pool(entry, 1);
    let (state, goal_state) = (Some(vec![30.0, 100.0]), Some(vec![60.0, 100.0]));
    pool.restart(&[0], |_, env| {
        env.reset(0, &ResetOptions { state: state.clone(), goal_state: goal_state.clone(), ..ResetOptions::default() })
    })
    .expect("resetting the environment");
    let mut environment = entry.env().expect("creating the environment");
    environment.restore(&pool.env(0).snapshot()).expect("restoring the snapshot");
    let mut rewards = 0.0;
    let ended = (1..=6).find(|_| {
        let outcome = environment.step(Action::Continuous(&[1.0, 0.0])).expect("stepping the environment");
        rewards += outcome.reward;
        outcome.terminated
    });
    assert!(ended.is_some_and(|steps| steps < 6), "{ended:?}: the goal ends the episode");
    let walk: Vec<f32> = (0..6).flat_map(|_| [1.0, 0.0]).collect();
    assert_eq!(costs(&mut simulator(entry, &pool, &[0], Score::Reward), &walk, 1, 1), [(0.0 - rewards) as f32]);
}

#[test]
fn success_score_weighs_the_agent_as_the_success_criterion_does() {
    let entry = &push_t::ENTRY;
    let mut pool = pool(entry, 1);
    pool.restart(&[0], |_, env| {
        let (state, goal) = ([100.0, 100.0, 300.0, 300.0, 1.0, 0.0, 0.0], [100.0, 140.0, 300.0, 300.0, 1.0, 0.0, 0.0]);
        let options =
            ResetOptions { state: Some(state.to_vec()), goal_state: Some(goal.to_vec()), ..ResetOptions::default() };
        env.reset(0, &options)
    })
    .expect("resetting the environment");
    let wait = [0.0; 2 * HORIZON * BLOCK];
    let cost = |score| costs(&mut simulator(entry, &pool, &[0], score), &wait, 1, 1)[0];
    assert!((cost(Score::Reach) - 0.1).abs() < 0.01, "the agent is 40 pixels away and weighs a twentieth");
    assert!((cost(Score::Success) - 2.0).abs() < 0.01, "the agent is two tolerances away");
    let walk: Vec<f32> = (0..HORIZON * BLOCK).flat_map(|_| [0.0, 0.5]).collect();
    let cost = costs(&mut simulator(entry, &pool, &[0], Score::Success), &walk, 1, 1)[0];
    assert!((-1.0..=0.0).contains(&cost), "{cost}: the agent arrives");
}

#[test]
fn costs_do_not_depend_on_other_environments_or_threads() {
    for entry in [&two_room::ENTRY, &push_t::ENTRY, &push_t::discrete::ENTRY] {
        let (envs, samples) = (3, 20);
        let pool = pool(entry, envs);
        let space = &pool.spec().action_space;
        let width: usize = match space {
            Space::MultiDiscrete { nvec, .. } => {
                nvec.iter().map(|&n| usize::try_from(n).expect("a count of options")).sum()
            }
            Space::Discrete { n, .. } => usize::try_from(*n).expect("a count of options"),
            _ => space.len(),
        };
        let own = samples * HORIZON * BLOCK * width;
        let all = actions(&mut Key::new(2).rng(), envs * own);
        let run = |threads: usize, slots: &[usize]| {
            let workers =
                rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("creating the thread pool");
            let actions: Vec<f32> = slots.iter().flat_map(|&slot| &all[slot * own..][..own]).copied().collect();
            let mut simulator = simulator(entry, &pool, slots, Score::Terminal);
            let costs = workers.install(|| costs(&mut simulator, &actions, slots.len(), samples));
            costs.chunks(samples).map(<[f32]>::to_vec).collect::<Vec<_>>()
        };
        let together = run(1, &[0, 1, 2]);
        assert!(
            together.iter().all(|costs| costs.iter().any(|&cost| cost != costs[0])),
            "{}: all candidates have the same cost",
            entry.id
        );
        assert_eq!(run(2, &[0, 1, 2]), together, "{}: two threads", entry.id);
        assert_eq!(
            run(2, &[2, 0]),
            [together[2].clone(), together[0].clone()],
            "{}: other environments in the call",
            entry.id
        );
    }
}

#[test]
fn rejects_environments_of_another_kind_and_wrong_shapes() {
    let (two_room_pool, push_t_pool) = (pool(&two_room::ENTRY, 1), pool(&push_t::ENTRY, 1));
    let mut simulator = simulator(&two_room::ENTRY, &two_room_pool, &[0], Score::Terminal);
    let message = simulator.observe_env(0, push_t_pool.env(0)).expect_err("another environment").to_string();
    assert!(message.contains(push_t::ENTRY.id) && message.contains(two_room::ENTRY.id), "{message}");
    let again = simulator
        .observe(two_room_pool.infos(), &[0])
        .expect_err("observing twice after passing the environment once")
        .to_string();
    assert!(again.contains("was not passed to the policy"), "{again}");
    let wide = Candidates { actions: &[0.0; 6], envs: 1, samples: 1, horizon: 1, dim: 6 };
    assert!(simulator.cost(wide, &mut [0.0]).expect_err("too many action values").to_string().contains("6 values"));
    let none = SimulatorCost::new(|| two_room::ENTRY.env(), ActionScale::identity(2), 0, Score::Terminal);
    assert!(none.err().expect("a block without actions is an error").to_string().contains("action block"));
}
