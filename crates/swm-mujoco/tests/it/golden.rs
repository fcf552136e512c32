//! Every recorded rollout of a MuJoCo world, step by step: states, observations, rewards, infos, and the first and last
//! picture. Reads `SWM_GOLDEN` and the folder beside this test.

use crate::similarity::ImageSimilarity;
use std::collections::BTreeMap;
use std::path::Path;
use swm_conformance::golden::{Golden, files, image_difference};
use swm_core::{Action, Batch, Env, FrameMut, ResetOptions, Schema, VariationRequest};
use swm_mujoco::ENVS;
use swm_mujoco::render::{self, Choice};

/// What is peculiar to the recordings of a family of worlds.
struct Family {
    /// How the names of its ids go on behind `swm/`, or end.
    named: fn(&str) -> bool,
    /// How far numbers may be apart, relative to those above 1.
    tolerance: f64,
    /// The factors that reached the model when this was recorded.
    factors: fn(&str, VariationRequest) -> VariationRequest,
    /// Fills in what the task remembers, at the start: its part of the `state` column.
    memory: fn(&mut Golden, &mut [f64]),
    /// Seconds of a step: velocities of joints are compared as distances in this time.
    step: f64,
    /// Rows of the recording that can be compared.
    until: fn(&str, &mut Golden) -> usize,
    /// Names of infos that are called differently here.
    renamed: &'static [(&'static str, &'static str)],
    /// Makes the goal's `state` column (or a place) of the start's, where the goal is none of the state.
    goal: fn(&mut Golden, &mut Vec<f64>),
}

const FAMILIES: &[Family] = &[
    Family {
        named: |id| id.starts_with("swm/Fetch"),
        // Recorded with MuJoCo 3.3.2.
        tolerance: 1e-4,
        // Asked to vary `all`, the reference samples every factor and applies none but this: it looks for their keys in the list.
        factors: |file, mut request| {
            if file.contains("-all-") {
                request.variation_values.retain(|key, _| key == "block.mass");
            }
            request
        },
        memory: |_, _| {},
        step: 0.04,
        until: fetch_until,
        renamed: &[("state", "observation"), ("goal_state", "desired_goal")],
        goal: |golden, goal| *goal = golden.values("info.goal_state")[..3].to_vec(),
    },
    Family {
        named: |id| id.starts_with("swm/OGBCube") || id.starts_with("swm/OGBScene"),
        tolerance: 1e-6,
        factors: |_, request| request,
        memory: table_memory,
        step: 0.05,
        until: table_until,
        renamed: &[],
        goal: |golden, state| table_goal(golden, state),
    },
    Family {
        named: |id| id.starts_with("swm/OGBMaze"),
        tolerance: 1e-6,
        factors: |_, request| request,
        memory: |golden, memory| {
            let pose = golden.values("qpos_qvel");
            let n = memory.len() - 1;
            memory[1..].copy_from_slice(&pose[..n]);
        },
        step: 0.1,
        until: |_, _| usize::MAX,
        renamed: &[],
        goal: |golden, state| {
            // Where nobody recorded the goal, nobody reached it: it is out of sight.
            let goal = if golden.has("goal.xy") { golden.values("goal.xy") } else { vec![1e3, 1e3] };
            state[1..3].copy_from_slice(&goal);
        },
    },
];

/// What a table remembers: contact, locks now and before, and the pose before.
fn table_memory(golden: &mut Golden, memory: &mut [f64]) {
    memory[0] = golden.values("info.proprio/gripper_contact")[0];
    if golden.has("info.button_states") {
        memory[1..3].copy_from_slice(&golden.values("info.button_states")[..2]);
        memory[3..5].copy_from_slice(&golden.values("info.prev_button_states")[..2]);
    }
    let [nq, nv] = ["start.qpos", "start.qvel"].map(|part| golden.values(part).len());
    memory[5..5 + nq].copy_from_slice(&golden.values("info.prev_qpos")[..nq]);
    memory[5 + nq..].copy_from_slice(&golden.values("info.prev_qvel")[..nv]);
}

/// Cubes where their markers are; locks, drawer and window as observed at the goal.
fn table_goal(golden: &mut Golden, state: &mut [f64]) {
    let (places, turns) = (golden.values("start.mocap_pos"), golden.values("start.mocap_quat"));
    let (poses, joints) = (golden.values("start.qpos").len(), state.len());
    let fixtures = golden.has("info.button_states");
    let (cubes, target) = (places.len() / 3, golden.values("info.target"));
    // Cubes stand behind the 14 joints of the arm and its gripper.
    for cube in 0..cubes {
        let at = &mut state[1 + 14 + 7 * cube..][..7];
        at[..3].copy_from_slice(&places[3 * cube..][..3]);
        at[3..].copy_from_slice(&turns[4 * cube..][..4]);
    }
    if fixtures {
        let memory = joints - (5 + poses + golden.values("start.qvel").len());
        (state[memory + 1], state[memory + 2]) = (target[29], target[33]);
        (state[poses - 1], state[poses]) = (target[36] / 18.0, target[38] / 15.0);
    }
}

/// All rows; of Slide those before the puck is struck, or before the world parts from itself. A puck is a cylinder: where it touches
/// a finger is found by iteration, whose last digits are another version's, and where it touches the table jumps along its rim.
fn fetch_until(file: &str, golden: &mut Golden) -> usize {
    if !file.contains("FetchSlide") {
        return usize::MAX;
    }
    let known = golden.values("info.proprio");
    // The puck's velocity is given relative to the gripper's, in metres per action.
    let speeds: Vec<f64> = known.chunks_exact(25).map(|row| (row[14] + row[20]).hypot(row[15] + row[21])).collect();
    let struck = speeds.windows(2).position(|pair| pair[1] - pair[0] > 5e-3).map_or(usize::MAX, |before| before + 1);
    struck.min(until_it_parts(&FAMILIES[0], file, golden))
}

/// Infos that are no columns of the world, or cannot be compared: its name, success, which the pool writes, and what was observed
/// at a goal of which no state was recorded.
const NO_COLUMNS: [&str; 4] = ["env_name", "success", "is_success", "target"];

/// Mean absolute difference of pictures, of 255.
const PICTURES: f64 = 3.0;

/// The parts of the physics in the `state` column, as recorded.
const START: [&str; 9] =
    ["time", "qpos", "qvel", "act", "qacc_warmstart", "ctrl", "eq_active", "mocap_pos", "mocap_quat"];

#[test]
fn rollouts_follow_the_reference() {
    let mut problems = vec![];
    for family in FAMILIES {
        let mut compared = 0;
        for row in ENVS.rows.iter().filter(|row| (family.named)(row.id)) {
            for file in files(env!("CARGO_MANIFEST_DIR"), &row.id.replace('/', "_")) {
                compared += 1;
                let env = recorded_in(&file).unwrap_or_else(|error| panic!("{}: {error}", row.id));
                problems.extend(Comparison::new(family, env, &file).run());
            }
        }
        assert!(compared > 0, "no rollouts of a family are there");
    }
    assert!(problems.is_empty(), "{}", problems.join("\n"));
}

/// The world of a file: `swm_ID,option=value-default-SEED.npz`.
fn recorded_in(file: &Path) -> swm_core::Result<Box<dyn Env>> {
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
    let (head, memory) = state.split_at_mut(physics.len());
    head.copy_from_slice(&physics);
    (family.memory)(golden, memory);
    state
}

/// One column as it is now.
fn column(env: &dyn Env, name: &str) -> Vec<f64> {
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("a schema"), 1);
    env.observe(&mut row.row_mut(0));
    row.row(0).to_f64(name).expect("a column")
}

/// All rows before the world parts from itself: where a gripper's mesh meets a button, the contacts that MuJoCo finds jump with the
/// last digit of a pose, and the reference does not follow its own recording.
fn table_until(name: &str, golden: &mut Golden) -> usize {
    until_it_parts(&FAMILIES[1], name, golden)
}

/// All rows before the world parts from itself after nudges of the last digits.
fn until_it_parts(family: &Family, name: &str, golden: &mut Golden) -> usize {
    let variation = (family.factors)(name, golden.variation());
    let options = ResetOptions { variation, ..ResetOptions::default() };
    let actions: Vec<f32> = golden.values("action").iter().map(|&a| a as f32).collect();
    let width = actions.len() / golden.values("reward").len();
    let pose = golden.values("start.qpos").len();
    let mut play = |nudge: f64| -> Vec<Vec<f64>> {
        let mut env = recorded_in(Path::new(name)).expect("a world");
        env.reset(0, &options).expect("a reset");
        let mut state = start(&*env, family, golden);
        state[1] += nudge;
        env.reset(0, &ResetOptions { state: Some(state), ..options.clone() }).expect("a reset");
        let mut step = |action| {
            env.step(Action::Continuous(action)).expect("a step");
            column(&*env, "state")[1..=pose].to_vec()
        };
        actions.chunks_exact(width).map(&mut step).collect()
    };
    let usual = play(0.0);
    let parted = [1e-13, -1e-13, 1e-14].into_iter().filter_map(|nudge| {
        let apart = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 1e-8);
        usual.iter().zip(&play(nudge)).position(apart)
    });
    // Row t + 1 follows action t.
    parted.min().map_or(usize::MAX, |step| step + 1)
}

/// The largest difference of one array, and where.
#[derive(Clone, Copy)]
struct Apart {
    by: f64,
    step: usize,
}

struct Comparison<'a> {
    family: &'a Family,
    name: String,
    env: Box<dyn Env>,
    row: Batch,
    golden: Golden,
    apart: BTreeMap<String, Apart>,
}

impl<'a> Comparison<'a> {
    fn new(family: &'a Family, env: Box<dyn Env>, file: &Path) -> Self {
        let row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("a schema"), 1);
        let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Self { family, name, env, row, golden: Golden::open(file), apart: BTreeMap::new() }
    }

    /// Plays the rollout; a sentence for each array that is too far away.
    fn run(mut self) -> Vec<String> {
        let names = self.golden.names();
        let variation = (self.family.factors)(&self.name, self.golden.variation());
        let mut options = ResetOptions { variation, ..ResetOptions::default() };
        self.env.reset(0, &options).unwrap_or_else(|error| panic!("{}: {error}", self.name));
        let start = start(&*self.env, self.family, &mut self.golden);
        let mut goal = start.clone();
        (self.family.goal)(&mut self.golden, &mut goal);
        options.goal_state = (goal != start).then_some(goal);
        options.state = Some(start);
        self.env.reset(0, &options).unwrap_or_else(|error| panic!("{}: {error}", self.name));

        let infos: Vec<(String, Vec<f64>)> = names
            .iter()
            .filter_map(|array| array.strip_prefix("info."))
            .filter(|info| !NO_COLUMNS.contains(info))
            .map(|info| (info.to_owned(), self.golden.values(&format!("info.{info}"))))
            .collect();
        let sights: Vec<(String, Vec<f64>)> = names
            .iter()
            .filter(|array| *array == "obs" || array.starts_with("obs."))
            .map(|array| (array.clone(), self.golden.values(array)))
            .collect();
        let positions = self.golden.values("qpos_qvel");
        let (rewards, endings) = (self.golden.values("reward"), self.golden.values("terminated"));
        let n = self.env.spec().action_dim();
        let actions: Vec<f32> = self.golden.values("action").iter().map(|&a| a as f32).collect();

        let pose = positions.len() / (rewards.len() + 1);
        let until = (self.family.until)(&self.name, &mut self.golden);
        self.picture("frame_first", &names);
        for step in 0..=rewards.len() {
            self.env.observe(&mut self.row.row_mut(0));
            let compared = step < until;
            if compared {
                self.poses(step, &positions[step * pose..(step + 1) * pose]);
            }
            for (info, recorded) in infos.iter().filter(|_| compared) {
                let renamed = self.family.renamed.iter().find(|(theirs, _)| theirs == info);
                let ours = self.column(renamed.map_or(info, |(_, ours)| ours));
                // Mazes say nothing at a reset.
                match (recorded.len() == rewards.len() * ours.len(), step) {
                    (true, 0) => {}
                    (true, _) => self.note(info, step - 1, &ours, recorded),
                    (false, _) => self.note(info, step, &ours, recorded),
                }
            }
            for (array, recorded) in sights.iter().filter(|_| compared) {
                let ours = self.seen(array.strip_prefix("obs."));
                self.note(array, step, &ours, recorded);
            }
            let Some(&reward) = rewards.get(step) else { break };
            let action = Action::Continuous(&actions[step * n..(step + 1) * n]);
            let transition = self.env.step(action).unwrap_or_else(|error| panic!("{}: {error}", self.name));
            if step + 1 < until {
                self.apart_at("reward", step, (transition.reward - reward).abs() / reward.abs().max(1.0));
                let ended = (f64::from(u8::from(transition.terminated)) - endings[step]).abs();
                self.apart_at("terminated", step, ended);
            }
        }
        self.picture("frame_last", &names);
        let limit = |array: &str| if array.starts_with("frame") { PICTURES } else { self.family.tolerance };
        let worst = self.apart.iter().map(|(array, apart)| format!("{array} {:.1e}", apart.by));
        let rows = until.min(rewards.len() + 1);
        #[allow(clippy::print_stderr, reason = "the table for whoever runs it with --no-capture")]
        {
            eprintln!("{}, {rows} rows: {}", self.name, worst.collect::<Vec<_>>().join(", "));
        }
        self.apart
            .iter()
            .filter(|(array, apart)| apart.by.is_nan() || apart.by > limit(array))
            .map(|(array, apart)| format!("{}: {array} is {:.2e} away at step {}", self.name, apart.by, apart.step))
            .collect()
    }

    fn column(&self, name: &str) -> Vec<f64> {
        self.row.row(0).to_f64(name).unwrap_or_else(|error| panic!("{}: {error}", self.name))
    }

    /// What an agent observes: one part of it, or all in their order.
    fn seen(&self, part: Option<&str>) -> Vec<f64> {
        let parts: Vec<&str> = match part {
            Some(part) => vec![part],
            None => self.env.spec().observation_space.iter().map(|(name, _)| *name).collect(),
        };
        parts.into_iter().flat_map(|part| self.column(part)).collect()
    }

    /// Compares coordinates, and velocities as distances in a step.
    fn poses(&mut self, step: usize, theirs: &[f64]) {
        let coordinates = self.golden.values("start.qpos").len();
        let scaled = |all: &[f64]| -> Vec<f64> {
            let scale = |i| if i < coordinates { 1.0 } else { self.family.step };
            all.iter().enumerate().map(|(i, x)| x * scale(i)).collect()
        };
        let (ours, theirs) = (scaled(&self.column("state")[1..=theirs.len()]), scaled(theirs));
        self.note("qpos_qvel", step, &ours, &[vec![0.0; step * ours.len()], theirs].concat());
    }

    /// Compares the numbers of a step.
    fn note(&mut self, array: &str, step: usize, ours: &[f64], recorded: &[f64]) {
        let Some(theirs) = recorded.get(step * ours.len()..(step + 1) * ours.len()) else {
            return self.apart_at(array, step, f64::NAN);
        };
        let apart = |(a, b): (&f64, &f64)| match (a.is_nan(), b.is_nan()) {
            (true, true) => 0.0,
            _ => (a - b).abs() / b.abs().max(1.0),
        };
        let most = ours.iter().zip(theirs).map(apart).fold(0.0, |a: f64, b| if b.is_nan() { b } else { a.max(b) });
        self.apart_at(array, step, most);
    }

    fn apart_at(&mut self, array: &str, step: usize, by: f64) {
        let known = self.apart.entry(array.to_owned()).or_insert(Apart { by, step });
        if by.is_nan() || by > known.by {
            *known = Apart { by, step };
        }
    }

    fn picture(&mut self, array: &str, names: &[String]) {
        if names.iter().any(|name| name == array) {
            let (height, width, wanted) = self.golden.image(array);
            let mut rgb = vec![0; wanted.len()];
            let frame = FrameMut::new(width, height, &mut rgb);
            render::with(Choice::Cpu, || self.env.render(frame)).unwrap_or_else(|error| panic!("{error}"));
            let name = format!("{}-{array}", self.name);
            if !ImageSimilarity::report(&name, &rgb, &wanted, width).is_close() {
                self.apart_at(&format!("{array} (cpu)"), 0, f64::INFINITY);
            }
            let frame = FrameMut::new(width, height, &mut rgb);
            render::with(Choice::Egl, || self.env.render(frame)).unwrap_or_else(|error| panic!("{error}"));
            self.apart_at(array, 0, image_difference(&rgb, &wanted));
        }
    }
}
