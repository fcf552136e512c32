//! Golden tests of Fetch and OGBench: every recorded rollout is replayed step by step and compared in states,
//! observations, rewards, infos, and the first and last frame.

use crate::similarity::ImageSimilarity;
use std::collections::BTreeMap;
use std::path::Path;
use swm_conformance::golden::{Golden, files, image_difference};
use swm_core::{Action, Batch, Env, FrameMut, ResetOptions, Schema, VariationRequest};
use swm_mujoco::ENVS;
use swm_mujoco::render::{self, Choice};

/// The settings with which the recordings of a family of environments are replayed and compared.
struct Family {
    /// Whether an id belongs to the family.
    includes: fn(&str) -> bool,
    /// The largest allowed difference, relative for values above 1.
    tolerance: f64,
    /// Selects the factors that the reference applied when it recorded a file.
    factors: fn(&str, VariationRequest) -> VariationRequest,
    /// Writes the task state at the start.
    task_state: fn(&mut Golden, &mut [f64]),
    /// Seconds per action: joint velocities are compared as displacements in this time.
    step: f64,
    /// The number of rows that can be compared.
    comparable_rows: fn(&str, &mut Golden) -> usize,
    /// Names of infos in the reference and of the corresponding columns, where the names differ.
    renamed: &'static [(&'static str, &'static str)],
    /// Changes a copy of the start state into the goal (a `state` column or a position).
    goal: fn(&mut Golden, &mut Vec<f64>),
}

const FAMILIES: &[Family] = &[
    Family {
        includes: |id| id.starts_with("swm/Fetch"),
        // The rollouts were recorded with MuJoCo 3.3.2.
        tolerance: 1e-4,
        // For a request of `all`, the reference samples every factor but applies only `block.mass`, because it looks
        // for the names of the other factors in the request.
        factors: |file, mut request| {
            if file.contains("-all-") {
                request.variation_values.retain(|key, _| key == "block.mass");
            }
            request
        },
        task_state: |_, _| {},
        step: 0.04,
        comparable_rows: fetch_rows,
        renamed: &[("state", "observation"), ("goal_state", "desired_goal")],
        goal: |golden, goal| *goal = golden.values("info.goal_state")[..3].to_vec(),
    },
    Family {
        includes: |id| id.starts_with("swm/OGBCube") || id.starts_with("swm/OGBScene"),
        tolerance: 1e-6,
        factors: |_, request| request,
        task_state: table_task_state,
        step: 0.05,
        comparable_rows: table_rows,
        renamed: &[],
        goal: |golden, state| table_goal(golden, state),
    },
    Family {
        includes: |id| id.starts_with("swm/OGBMaze"),
        tolerance: 1e-6,
        factors: |_, request| request,
        task_state: |golden, task_state| {
            let pose = golden.values("qpos_qvel");
            let n = task_state.len() - 1;
            task_state[1..].copy_from_slice(&pose[..n]);
        },
        step: 0.1,
        comparable_rows: |_, _| usize::MAX,
        renamed: &[],
        goal: |golden, state| {
            // Files without a recorded goal end before the goal is reached, so an unreachable point gives the same
            // results.
            let goal = if golden.has("goal.xy") { golden.values("goal.xy") } else { vec![1e3, 1e3] };
            state[1..3].copy_from_slice(&goal);
        },
    },
];

/// Writes the task state of a table: gripper contact, button states of this and the previous step, and the previous
/// pose.
fn table_task_state(golden: &mut Golden, task_state: &mut [f64]) {
    task_state[0] = golden.values("info.proprio/gripper_contact")[0];
    if golden.has("info.button_states") {
        task_state[1..3].copy_from_slice(&golden.values("info.button_states")[..2]);
        task_state[3..5].copy_from_slice(&golden.values("info.prev_button_states")[..2]);
    }
    let [nq, nv] = ["start.qpos", "start.qvel"].map(|part| golden.values(part).len());
    task_state[5..5 + nq].copy_from_slice(&golden.values("info.prev_qpos")[..nq]);
    task_state[5 + nq..].copy_from_slice(&golden.values("info.prev_qvel")[..nv]);
}

/// Moves the cubes to their markers, and sets locks, drawer and window to the observation at the goal.
fn table_goal(golden: &mut Golden, state: &mut [f64]) {
    let (positions, quats) = (golden.values("start.mocap_pos"), golden.values("start.mocap_quat"));
    let (nq, len) = (golden.values("start.qpos").len(), state.len());
    let fixtures = golden.has("info.button_states");
    let (cubes, target) = (positions.len() / 3, golden.values("info.target"));
    // The cubes follow the 14 joints of the arm and its gripper.
    for cube in 0..cubes {
        let at = &mut state[1 + 14 + 7 * cube..][..7];
        at[..3].copy_from_slice(&positions[3 * cube..][..3]);
        at[3..].copy_from_slice(&quats[4 * cube..][..4]);
    }
    if fixtures {
        let task_state = len - (5 + nq + golden.values("start.qvel").len());
        (state[task_state + 1], state[task_state + 2]) = (target[29], target[33]);
        (state[nq - 1], state[nq]) = (target[36] / 18.0, target[38] / 15.0);
    }
}

/// The number of rows to compare: all rows; for Slide, the rows before the puck is struck or the simulation becomes
/// chaotic. A puck is a cylinder: MuJoCo computes its contacts with a finger iteratively, with last digits that differ
/// between versions, and its contacts with the table jump along the puck's rim.
fn fetch_rows(file: &str, golden: &mut Golden) -> usize {
    if !file.contains("FetchSlide") {
        return usize::MAX;
    }
    let proprio = golden.values("info.proprio");
    // The recorded velocity of the puck is relative to the gripper, in metres per action.
    let speeds: Vec<f64> = proprio.chunks_exact(25).map(|row| (row[14] + row[20]).hypot(row[15] + row[21])).collect();
    let struck = speeds.windows(2).position(|pair| pair[1] - pair[0] > 5e-3).map_or(usize::MAX, |before| before + 1);
    struck.min(rows_before_chaos(&FAMILIES[0], file, golden))
}

/// Infos that are not compared: the name, which has no column; success, which the pool writes; and the observation at
/// the goal, whose state was not recorded.
const SKIPPED_INFOS: [&str; 4] = ["env_name", "success", "is_success", "target"];

/// The largest allowed mean absolute difference of images, in units of 1/255.
const IMAGE_TOLERANCE: f64 = 3.0;

/// The recorded parts of the physics' state, in the order of the `state` column.
const START: [&str; 9] =
    ["time", "qpos", "qvel", "act", "qacc_warmstart", "ctrl", "eq_active", "mocap_pos", "mocap_quat"];

#[test]
fn rollouts_match_the_reference() {
    let mut problems = vec![];
    for family in FAMILIES {
        let mut compared = 0;
        for row in ENVS.rows.iter().filter(|row| (family.includes)(row.id)) {
            for file in files(env!("CARGO_MANIFEST_DIR"), &row.id.replace('/', "_")) {
                compared += 1;
                let env = recorded_env(&file).unwrap_or_else(|error| panic!("{}: {error}", row.id));
                problems.extend(Comparison::new(family, env, &file).run());
            }
        }
        assert!(compared > 0, "a family has no recorded rollouts");
    }
    assert!(problems.is_empty(), "{}", problems.join("\n"));
}

/// Creates the environment of a file named `swm_ID,option=value-default-SEED.npz`.
fn recorded_env(file: &Path) -> swm_core::Result<Box<dyn Env>> {
    let name = file.file_stem().unwrap_or_default().to_string_lossy();
    let end = ["-all-", "-each-", "-default-"].into_iter().find_map(|kind| name.rfind(kind)).unwrap_or(name.len());
    ENVS.choose(&name[..end].replacen('_', "/", 1))?.env()
}

/// The recorded start as a `state` column.
fn start(env: &dyn Env, family: &Family, golden: &mut Golden) -> Vec<f64> {
    let mut state = column(env, "state");
    let (names, mut physics) = (golden.names(), vec![]);
    for part in START {
        let array = format!("start.{part}");
        if names.contains(&array) {
            physics.extend(golden.values(&array));
        } else {
            assert!(!["qacc_warmstart", "qvel"].contains(&part), "{array} is not recorded");
        }
    }
    let (head, task_state) = state.split_at_mut(physics.len());
    head.copy_from_slice(&physics);
    (family.task_state)(golden, task_state);
    state
}

/// The present value of a column.
fn column(env: &dyn Env, name: &str) -> Vec<f64> {
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("creating the schema"), 1);
    env.observe(&mut row.row_mut(0));
    row.row(0).to_f64(name).expect("reading a column")
}

/// The number of rows before the simulation becomes chaotic: where the gripper's mesh touches a button, the contacts
/// that MuJoCo finds jump with the last digit of a pose, and the reference does not reproduce its own recording.
fn table_rows(name: &str, golden: &mut Golden) -> usize {
    rows_before_chaos(&FAMILIES[1], name, golden)
}

/// The number of rows before perturbations of the last digits change the trajectory.
fn rows_before_chaos(family: &Family, name: &str, golden: &mut Golden) -> usize {
    let variation = (family.factors)(name, golden.variation());
    let options = ResetOptions { variation, ..ResetOptions::default() };
    let actions: Vec<f32> = golden.values("action").iter().map(|&a| a as f32).collect();
    let action_dim = actions.len() / golden.values("reward").len();
    let qpos_len = golden.values("start.qpos").len();
    let mut play = |perturbation: f64| -> Vec<Vec<f64>> {
        let mut env = recorded_env(Path::new(name)).expect("creating the environment");
        env.reset(0, &options).expect("resetting the environment");
        let mut state = start(&*env, family, golden);
        state[1] += perturbation;
        env.reset(0, &ResetOptions { state: Some(state), ..options.clone() }).expect("resetting the environment");
        let mut step = |action| {
            env.step(Action::Continuous(action)).expect("stepping the environment");
            column(&*env, "state")[1..=qpos_len].to_vec()
        };
        actions.chunks_exact(action_dim).map(&mut step).collect()
    };
    let unperturbed = play(0.0);
    let diverged = [1e-13, -1e-13, 1e-14].into_iter().filter_map(|perturbation| {
        let differs = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 1e-8);
        unperturbed.iter().zip(&play(perturbation)).position(differs)
    });
    // Row t + 1 follows action t.
    diverged.min().map_or(usize::MAX, |step| step + 1)
}

/// The largest difference of an array, and the step where it occurs.
#[derive(Clone, Copy)]
struct Difference {
    value: f64,
    step: usize,
}

/// The replay of a rollout.
struct Comparison<'a> {
    family: &'a Family,
    name: String,
    env: Box<dyn Env>,
    row: Batch,
    golden: Golden,
    differences: BTreeMap<String, Difference>,
}

impl<'a> Comparison<'a> {
    fn new(family: &'a Family, env: Box<dyn Env>, file: &Path) -> Self {
        let row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("creating the schema"), 1);
        let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Self { family, name, env, row, golden: Golden::open(file), differences: BTreeMap::new() }
    }

    /// Resets the environment to the recorded start and goal.
    fn reset(&mut self) {
        let variation = (self.family.factors)(&self.name, self.golden.variation());
        let mut options = ResetOptions { variation, ..ResetOptions::default() };
        self.env.reset(0, &options).unwrap_or_else(|error| panic!("{}: {error}", self.name));
        let start = start(&*self.env, self.family, &mut self.golden);
        let mut goal = start.clone();
        (self.family.goal)(&mut self.golden, &mut goal);
        options.goal_state = (goal != start).then_some(goal);
        options.state = Some(start);
        self.env.reset(0, &options).unwrap_or_else(|error| panic!("{}: {error}", self.name));
    }

    /// Replays the rollout and returns a message for each array that differs too much.
    fn run(mut self) -> Vec<String> {
        self.reset();
        let names = self.golden.names();
        let infos: Vec<(String, Vec<f64>)> = names
            .iter()
            .filter_map(|array| array.strip_prefix("info."))
            .filter(|info| !SKIPPED_INFOS.contains(info))
            .map(|info| (info.to_owned(), self.golden.values(&format!("info.{info}"))))
            .collect();
        let observations: Vec<(String, Vec<f64>)> = names
            .iter()
            .filter(|array| *array == "obs" || array.starts_with("obs."))
            .map(|array| (array.clone(), self.golden.values(array)))
            .collect();
        let positions = self.golden.values("qpos_qvel");
        let (rewards, endings) = (self.golden.values("reward"), self.golden.values("terminated"));
        let action_dim = self.env.spec().action_dim();
        let actions: Vec<f32> = self.golden.values("action").iter().map(|&a| a as f32).collect();

        let pose_len = positions.len() / (rewards.len() + 1);
        let row_count = (self.family.comparable_rows)(&self.name, &mut self.golden);
        self.compare_image("frame_first", &names);
        for step in 0..=rewards.len() {
            self.env.observe(&mut self.row.row_mut(0));
            if step < row_count {
                self.compare_pose(step, &positions[step * pose_len..(step + 1) * pose_len]);
                self.compare_infos(step, &infos, rewards.len());
                for (array, recorded) in &observations {
                    let ours = self.observation(array.strip_prefix("obs."));
                    self.compare(array, step, &ours, recorded);
                }
            }
            let Some(&reward) = rewards.get(step) else { break };
            let action = Action::Continuous(&actions[step * action_dim..(step + 1) * action_dim]);
            let transition = self.env.step(action).unwrap_or_else(|error| panic!("{}: {error}", self.name));
            if step + 1 < row_count {
                self.note_difference("reward", step, (transition.reward - reward).abs() / reward.abs().max(1.0));
                let ended = (f64::from(u8::from(transition.terminated)) - endings[step]).abs();
                self.note_difference("terminated", step, ended);
            }
        }
        self.compare_image("frame_last", &names);
        self.report(row_count.min(rewards.len() + 1))
    }

    /// Compares the infos of a step. Mazes of the reference have no infos at a reset.
    fn compare_infos(&mut self, step: usize, infos: &[(String, Vec<f64>)], steps: usize) {
        for (info, recorded) in infos {
            let renamed = self.family.renamed.iter().find(|(theirs, _)| theirs == info);
            let ours = self.column(renamed.map_or(info, |(_, ours)| ours));
            match (recorded.len() == steps * ours.len(), step) {
                (true, 0) => {}
                (true, _) => self.compare(info, step - 1, &ours, recorded),
                (false, _) => self.compare(info, step, &ours, recorded),
            }
        }
    }

    /// Prints the largest difference of each array, and returns a message for each array that exceeds its tolerance.
    #[allow(clippy::print_stderr, reason = "a table for `--no-capture`")]
    fn report(&self, rows: usize) -> Vec<String> {
        let limit = |array: &str| if array.starts_with("frame") { IMAGE_TOLERANCE } else { self.family.tolerance };
        let worst = self.differences.iter().map(|(array, difference)| format!("{array} {:.1e}", difference.value));
        eprintln!("{}, {rows} rows: {}", self.name, worst.collect::<Vec<_>>().join(", "));
        self.differences
            .iter()
            .filter(|(array, difference)| difference.value.is_nan() || difference.value > limit(array))
            .map(|(array, Difference { value, step })| {
                format!("{}: {array} differs by {value:.2e} at step {step}", self.name)
            })
            .collect()
    }

    fn column(&self, name: &str) -> Vec<f64> {
        self.row.row(0).to_f64(name).unwrap_or_else(|error| panic!("{}: {error}", self.name))
    }

    /// One array of the observation, or all arrays in order.
    fn observation(&self, array: Option<&str>) -> Vec<f64> {
        let arrays: Vec<&str> = match array {
            Some(array) => vec![array],
            None => self.env.spec().observation_space.iter().map(|(name, _)| *name).collect(),
        };
        arrays.into_iter().flat_map(|array| self.column(array)).collect()
    }

    /// Compares positions, and velocities as displacements in a step.
    fn compare_pose(&mut self, step: usize, theirs: &[f64]) {
        let coordinates = self.golden.values("start.qpos").len();
        let scaled = |all: &[f64]| -> Vec<f64> {
            let scale = |i| if i < coordinates { 1.0 } else { self.family.step };
            all.iter().enumerate().map(|(i, x)| x * scale(i)).collect()
        };
        let (ours, theirs) = (scaled(&self.column("state")[1..=theirs.len()]), scaled(theirs));
        self.compare("qpos_qvel", step, &ours, &[vec![0.0; step * ours.len()], theirs].concat());
    }

    /// Compares the values of a step with the values of the same step in a recorded array.
    fn compare(&mut self, array: &str, step: usize, ours: &[f64], recorded: &[f64]) {
        let Some(theirs) = recorded.get(step * ours.len()..(step + 1) * ours.len()) else {
            return self.note_difference(array, step, f64::NAN);
        };
        let difference = |(a, b): (&f64, &f64)| match (a.is_nan(), b.is_nan()) {
            (true, true) => 0.0,
            _ => (a - b).abs() / b.abs().max(1.0),
        };
        let largest =
            ours.iter().zip(theirs).map(difference).fold(0.0, |a: f64, b| if b.is_nan() { b } else { a.max(b) });
        self.note_difference(array, step, largest);
    }

    fn note_difference(&mut self, array: &str, step: usize, value: f64) {
        let largest = self.differences.entry(array.to_owned()).or_insert(Difference { value, step });
        if value.is_nan() || value > largest.value {
            *largest = Difference { value, step };
        }
    }

    /// Compares the frames of both renderers with a recorded image.
    fn compare_image(&mut self, array: &str, names: &[String]) {
        if names.iter().any(|name| name == array) {
            let (height, width, expected) = self.golden.image(array);
            let mut rgb = vec![0; expected.len()];
            let frame = FrameMut::new(width, height, &mut rgb);
            render::with(Choice::Cpu, || self.env.render(frame)).unwrap_or_else(|error| panic!("{error}"));
            let name = format!("{}-{array}", self.name);
            if !ImageSimilarity::report(&name, &rgb, &expected, width).is_close() {
                self.note_difference(&format!("{array} (cpu)"), 0, f64::INFINITY);
            }
            let frame = FrameMut::new(width, height, &mut rgb);
            render::with(Choice::Egl, || self.env.render(frame)).unwrap_or_else(|error| panic!("{error}"));
            self.note_difference(array, 0, image_difference(&rgb, &expected));
        }
    }
}
