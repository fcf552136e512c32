//! Golden tests: every domain reproduces rollouts that the Python reference recorded (`SWM_GOLDEN`, and
//! `tests/golden`).
//!
//! The tests call [`SuiteTask`] instead of [`swm_core::Env`], whose actions are in single precision: actions of the
//! reference are in double precision, and with contacts the difference grows quickly.

use super::ENTRIES;
use super::domain::Domain;
use super::suite_env::{SuiteTask, env_arguments};
use crate::Physics;
use crate::render::similarity::ImageSimilarity;
use crate::render::{self, Choice, FrameBuffer};
use crate::task::Task as _;
use std::path::Path;
use std::sync::Arc;
use swm_conformance::golden::{self, Golden};
use swm_core::{Batch, ColumnSpec, DType, EnvChoice, Key, Registry, Schema, columns};

/// The largest allowed difference of values.
const TOLERANCE: f64 = 1e-6;
/// The largest allowed mean difference of images, on a scale of 0 to 255.
const IMAGE_TOLERANCE: f64 = 3.0;

/// The position of the task's target in a recording.
fn target<D: Domain>(golden: &mut Golden) -> Vec<f64> {
    if golden.has("start.target") {
        let target = golden.values("start.target");
        return match D::MODEL {
            "reacher.xml" => target[..2].to_vec(),
            "finger.xml" => vec![target[0], target[2]],
            "manipulator.xml" => vec![target[0], target[2], target[3], target[5]],
            _ => vec![],
        };
    }
    match D::MODEL {
        "reacher.xml" => golden.values("info.target_pos")[..2].to_vec(),
        // The recorded position is relative to the hinge.
        "finger.xml" => {
            let relative = golden.values("info.target_position");
            vec![relative[0] + 0.2, relative[1] + 0.4]
        }
        // The target's pose is at the end of the observation, in single precision.
        "manipulator.xml" => golden.values("obs")[40..44].to_vec(),
        _ => vec![],
    }
}

/// The largest difference of two vectors; two NaN count as equal.
fn largest_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| if a.is_nan() && b.is_nan() { 0.0 } else { (a - b).abs() })
        .fold(0.0, |worst, d| if d.is_nan() { f64::INFINITY } else { worst.max(d) })
}

/// The replay of a rollout in a domain.
struct Replay<D: Domain> {
    physics: Physics,
    task: SuiteTask<D>,
    scene: Option<Box<render::AbstractScene>>,
    row: Batch,
}

impl<D: Domain> Replay<D> {
    fn column(&mut self, name: &str) -> Vec<f64> {
        self.task.observe(&self.physics, &mut self.row.row_mut(0));
        self.row.row(0).to_f64(name).expect("reading a column")
    }

    /// The mean difference between MuJoCo's frame and a recorded image, from 0 to 255, and whether the frame of the CPU
    /// renderer is close to the recorded image.
    fn compare_image(&mut self, file: &Path, golden: &mut Golden, name: &str) -> (f64, bool) {
        if !golden.has(name) {
            return (0.0, true);
        }
        let (height, width, expected) = golden.image(name);
        let mut rgb = vec![0; expected.len()];
        let camera = self.task.camera();
        let mut draw = |choice| {
            let buffer = FrameBuffer::Rgb(&mut rgb);
            render::with(choice, || render::draw(&mut self.scene, &mut self.physics, camera, (width, height), buffer))
                .expect("rendering a frame");
            rgb.clone()
        };
        let (cpu, egl) = (draw(Choice::Cpu), draw(Choice::Egl));
        let name = format!("{}-{name}", file.file_stem().unwrap_or_default().to_string_lossy());
        (
            ImageSimilarity::of(&egl, &expected, width).difference,
            ImageSimilarity::report(&name, &cpu, &expected, width).is_close(),
        )
    }
}

/// The largest differences between a replayed and a recorded rollout.
#[derive(Debug, Default)]
struct Worst {
    state: f64,
    observation: f64,
    reward: f64,
    info: f64,
    images: [(f64, bool); 2],
}

fn replay_one<D: Domain>(file: &Path) -> Worst {
    let mut golden = Golden::open(file);
    let task = if golden.has("task") { golden.text("task") } else { D::TASKS.names[0].to_owned() };
    let registry = Registry { kind: "environment", hint: "", rows: &ENTRIES };
    let choice: EnvChoice = registry.choose(&format!("{},task={task}", D::ID)).expect("choosing the environment");
    let (spec, model, mut task) = env_arguments::<D>(&choice).expect("preparing the environment");
    let factors = spec.variation_space.resolve(&golden.variation(), Key::new(0)).expect("resolving the factors");
    let mut physics = Physics::new(Arc::clone(&model)).expect("allocating the state");
    task.apply_factors(&mut physics, &factors).expect("applying the factors");
    task.start(&mut physics, &factors, Key::new(0)).expect("starting an episode");

    // Sets the recorded start.
    let mut state = vec![];
    for name in
        ["time", "qpos", "qvel", "act", "qacc_warmstart", "ctrl", "eq_active"].map(|field| format!("start.{field}"))
    {
        if golden.has(&name) {
            state.extend(golden.values(&name));
        }
    }
    let mut task_state = vec![0.0; task.task_state_len(&model)];
    task.save_task_state(&mut task_state);
    task_state[1..=D::TARGET_LEN].copy_from_slice(&target::<D>(&mut golden));
    task.load_task_state(&mut physics, &task_state);
    physics.set_state(&state).expect("setting the state");
    physics.forward_passive();

    // The columns of the environment: `state` and `unstable`, then the columns of the task.
    let common_columns = [ColumnSpec::new("state", DType::Float64, [1]), ColumnSpec::new("unstable", DType::Bool, [])];
    let specs: Vec<ColumnSpec> = common_columns.into_iter().chain(spec.columns.clone()).collect();
    let row = Batch::zeros(&Schema::new(specs).expect("creating the schema"), 1);
    let mut replay = Replay { physics, task, scene: None, row };

    let (actions, rewards, terminations) =
        (golden.values("action"), golden.values("reward"), golden.values(columns::TERMINATED));
    let (states, observations) = (golden.values("qpos_qvel"), golden.values("obs"));
    let infos: Vec<(&str, Vec<f64>)> =
        D::INFO.iter().map(|info| (info.name, golden.values(&format!("info.{}", info.name)))).collect();
    let mut worst = Worst::default();
    worst.images[0] = replay.compare_image(file, &mut golden, "frame_first");
    let action_dim = spec.action_space.len();
    for t in 0..=rewards.len() {
        if t > 0 {
            let step = replay
                .task
                .apply_action(&mut replay.physics, actions[(t - 1) * action_dim..t * action_dim].iter().copied());
            worst.reward = worst.reward.max((step.reward - rewards[t - 1]).abs());
            assert_eq!(step.terminated, terminations[t - 1] > 0.0, "{}: termination at step {t}", file.display());
        }
        let mut qpos_qvel = replay.column("qpos");
        qpos_qvel.extend(replay.column("qvel"));
        worst.state =
            worst.state.max(largest_difference(&qpos_qvel, &states[t * qpos_qvel.len()..][..qpos_qvel.len()]));
        let observation = replay.column("observation");
        let expected = &observations[t * observation.len()..][..observation.len()];
        worst.observation = worst.observation.max(largest_difference(&observation, expected));
        for (name, recorded) in &infos {
            let info = replay.column(name);
            worst.info = worst.info.max(largest_difference(&info, &recorded[t * info.len()..][..info.len()]));
        }
    }
    worst.images[1] = replay.compare_image(file, &mut golden, "frame_last");
    worst
}

/// Replays every recorded rollout of a domain.
#[allow(clippy::print_stderr, reason = "a table for `--nocapture`")]
fn replay_all<D: Domain>() {
    let files = golden::files(env!("CARGO_MANIFEST_DIR"), &format!("{}-", D::ID.replace('/', "_")));
    assert!(!files.is_empty(), "`tests/golden` has no file of {}", D::ID);
    let mut different = vec![];
    for file in files {
        let worst = replay_one::<D>(&file);
        let name = file.file_name().expect("reading the file name").to_string_lossy().into_owned();
        eprintln!("{name}: {worst:?}");
        let values = worst.state.max(worst.observation).max(worst.reward).max(worst.info);
        if values > TOLERANCE || worst.images.iter().any(|(egl, cpu)| *egl > IMAGE_TOLERANCE || !cpu) {
            different.push(format!("{name}: {worst:?}"));
        }
    }
    assert!(different.is_empty(), "rollouts that differ: {different:#?}");
}

macro_rules! replay_tests {
    ($($name:ident $domain:ty;)*) => {$(
        #[test]
        fn $name() {
            replay_all::<$domain>();
        }
    )*};
}

replay_tests! {
    acrobot_follows_the_reference super::acrobot::Acrobot;
    ball_in_cup_follows_the_reference super::ball_in_cup::BallInCup;
    cartpole_follows_the_reference super::cartpole::Cartpole;
    cheetah_follows_the_reference super::cheetah::Cheetah;
    finger_follows_the_reference super::finger::Finger;
    hopper_follows_the_reference super::hopper::Hopper;
    humanoid_follows_the_reference super::humanoid::Humanoid;
    manipulator_follows_the_reference super::manipulator::Manipulator;
    pendulum_follows_the_reference super::pendulum::Pendulum;
    quadruped_follows_the_reference super::quadruped::Quadruped;
    reacher_follows_the_reference super::reacher::Reacher;
    walker_follows_the_reference super::walker::Walker;
}
