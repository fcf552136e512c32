//! The motion of the planning experts of Push-T: actions, speed of the agent and of the block, success.

use std::f64::consts::PI;
use swm_core::columns::STATE;
use swm_core::{Action, Batch, EnvEntry, ExpertEntry, Key, ResetOptions, Schema};
use swm_envs::ENVS;

/// The layout of the `state` column.
type State = [f64; 7];

/// One episode: its states, one more than its actions, and whether it ended at the goal.
struct Episode {
    states: Vec<State>,
    actions: Vec<[f64; 2]>,
    success: bool,
}

/// The statistics of some episodes. Speeds are those of an agent with ten steps per second.
struct Motion {
    success_rate: f64,
    /// The mean number of steps.
    length: f64,
    /// The standard deviation of an action component.
    action_std: f64,
    /// The share of action components at a bound of the action space.
    saturated: f64,
    /// The standard deviation of a component of the agent's velocity, in pixels per second.
    agent_speed_std: f64,
    /// The median distance that the block moves in 25 steps, in pixels.
    block_distance: f64,
    /// The median angle that the block rotates by in 25 steps, in degrees.
    block_rotation: f64,
}

impl std::fmt::Display for Motion {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{:.1} % | {:.0} | {:.2} | {:.1} % | {:.0} | {:.0} | {:.0}",
            100.0 * self.success_rate,
            self.length,
            self.action_std,
            100.0 * self.saturated,
            self.agent_speed_std,
            self.block_distance,
            self.block_rotation
        )
    }
}

/// Plays an episode until success or the time limit.
fn play(entry: &EnvEntry, expert: &ExpertEntry, seed: u64, time_limit: usize) -> Episode {
    let mut env = entry.env().expect("creating the environment");
    let mut expert = (expert.make)();
    let schema = Schema::new(env.spec().columns.clone()).expect("creating the schema");
    let mut infos = Batch::zeros(&schema, 1);
    env.reset(seed, &ResetOptions::default()).expect("resetting the environment");
    expert.begin(Key::new(seed));
    let mut episode = Episode { states: vec![], actions: vec![], success: false };
    loop {
        env.observe(&mut infos.row_mut(0));
        let state = infos.row(0).get::<f64>(STATE).expect("reading the state");
        episode.states.push(state.try_into().expect("the state has seven values"));
        episode.success = env.is_success();
        if episode.success || episode.actions.len() == time_limit {
            return episode;
        }
        let mut action = [0.0; 2];
        expert.act(infos.row(0), &mut action).expect("choosing an action");
        env.step(Action::Continuous(&action.map(|v| v as f32))).expect("stepping the environment");
        episode.actions.push(action);
    }
}

fn std(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    (values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / values.len() as f64).sqrt()
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Plays episodes 0, 1, … on two threads.
fn motion(expert: &str, episodes: u64, time_limit: usize) -> Motion {
    let entry = ENVS.get("swm/PushT-v1").expect("finding the environment");
    let expert = entry.experts.iter().find(|row| row.id == expert).expect("finding the expert");
    let share = |first: u64| (first..episodes).step_by(2).map(|seed| play(entry, expert, seed, time_limit)).collect();
    let played: Vec<Episode> = std::thread::scope(|scope| {
        let threads = [0, 1].map(|first| scope.spawn(move || -> Vec<Episode> { share(first) }));
        threads.into_iter().flat_map(|thread| thread.join().expect("playing the episodes")).collect()
    });
    let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / played.len() as f64;
    let actions: Vec<f64> = played.iter().flat_map(|episode| episode.actions.iter().flatten().copied()).collect();
    let states = || played.iter().flat_map(|episode| &episode.states);
    let windows = || played.iter().flat_map(|episode| episode.states.windows(26)).map(|states| (states[0], states[25]));
    let rotation = |(a, b): (State, State)| ((b[4] - a[4] + PI).rem_euclid(2.0 * PI) - PI).abs().to_degrees();
    Motion {
        success_rate: mean(&mut played.iter().map(|episode| f64::from(u8::from(episode.success)))),
        length: mean(&mut played.iter().map(|episode| episode.actions.len() as f64)),
        action_std: std(&actions),
        saturated: actions.iter().filter(|v| v.abs() > 0.999).count() as f64 / actions.len() as f64,
        agent_speed_std: std(&states().flat_map(|state| [state[5], state[6]]).collect::<Vec<_>>()),
        block_distance: median(windows().map(|(a, b)| (b[2] - a[2]).hypot(b[3] - a[3])).collect()),
        block_rotation: median(windows().map(rotation).collect()),
    }
}

/// The README of the environment has the printed rows.
#[test]
#[allow(clippy::print_stdout, reason = "cargo shows the rows with --nocapture")]
fn experts_move_at_their_stated_speed() {
    let fast = motion("expert", 200, 200);
    let paper = motion("paper-speed", 200, 300);
    println!("`expert` | {fast}\n`paper-speed` | {paper}");
    assert!(fast.success_rate >= 0.95 && fast.action_std > 0.5, "{fast}");
    assert!(paper.success_rate >= 0.95 && (100.0..300.0).contains(&paper.length), "{paper}");
    assert!((paper.action_std - 0.20).abs() <= 0.02 && paper.saturated == 0.0, "{paper}");
    assert!((paper.agent_speed_std - 75.0).abs() <= 10.0, "{paper}");
}
