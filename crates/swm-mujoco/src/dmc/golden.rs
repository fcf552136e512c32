//! The suite against rollouts of the Python reference: those of `SWM_GOLDEN`, and those beside the tests.
//!
//! They are followed below [`swm_core::Env`], whose actions are single precision: the reference's are not, and where there are
//! contacts the last digits of an action decide.

#[path = "../../tests/it/recorded.rs"]
mod recorded;

use super::env::{Control, parts};
use super::{Domain, ENTRIES};
use crate::Physics;
use crate::render::similarity::ImageSimilarity;
use crate::render::{self, Choice, FrameBuffer};
use crate::task::Task as _;
use recorded::Golden;
use std::path::Path;
use std::sync::Arc;
use swm_core::{Batch, ColumnSpec, DType, EnvChoice, Key, Registry, Schema};

/// How far numbers may be apart.
const NEAR: f64 = 1e-6;
/// How far pictures may be apart, of 255.
const ALIKE: f64 = 3.0;

/// Where the task's target is. The suite draws it, and shows it to the agent.
fn target<D: Domain>(golden: &mut Golden) -> Vec<f64> {
    if golden.has("start.target") {
        let target = golden.numbers("start.target");
        return match D::MODEL {
            "reacher.xml" => target[..2].to_vec(),
            "finger.xml" => vec![target[0], target[2]],
            "manipulator.xml" => vec![target[0], target[2], target[3], target[5]],
            _ => vec![],
        };
    }
    match D::MODEL {
        "reacher.xml" => golden.numbers("info.target_pos")[..2].to_vec(),
        // Beside the hinge.
        "finger.xml" => {
            let beside = golden.numbers("info.target_position");
            vec![beside[0] + 0.2, beside[1] + 0.4]
        }
        // In single precision, at the end of the observation.
        "manipulator.xml" => golden.numbers("obs")[40..44].to_vec(),
        _ => vec![],
    }
}

/// The greatest difference of two lists; where both are no number, there is none.
fn apart(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter()
        .zip(b)
        .map(|(a, b)| if a.is_nan() && b.is_nan() { 0.0 } else { (a - b).abs() })
        .fold(0.0, |worst, d| if d.is_nan() { f64::INFINITY } else { worst.max(d) })
}

/// A world while a rollout is followed.
struct Follower<D: Domain> {
    physics: Physics,
    control: Control<D>,
    stage: Option<Box<render::AbstractScene>>,
    row: Batch,
}

impl<D: Domain> Follower<D> {
    fn column(&mut self, name: &str) -> Vec<f64> {
        self.control.observe(&self.physics, &mut self.row.row_mut(0));
        self.row.row(0).to_f64(name).expect("a column")
    }

    /// How far MuJoCo's picture is from a recorded one, of 255, and whether the CPU's is like it.
    fn picture(&mut self, file: &Path, golden: &mut Golden, name: &str) -> (f64, bool) {
        if !golden.has(name) {
            return (0.0, true);
        }
        let (height, width, wanted) = golden.picture(name);
        let mut rgb = vec![0; wanted.len()];
        let camera = self.control.camera();
        let mut draw = |choice| {
            let picture = FrameBuffer::Rgb(&mut rgb);
            render::with(choice, || render::draw(&mut self.stage, &mut self.physics, camera, (width, height), picture))
                .expect("a picture");
            rgb.clone()
        };
        let (cpu, egl) = (draw(Choice::Cpu), draw(Choice::Egl));
        let name = format!("{}-{name}", file.file_stem().unwrap_or_default().to_string_lossy());
        (
            ImageSimilarity::of(&egl, &wanted, width).difference,
            ImageSimilarity::report(&name, &cpu, &wanted, width).is_close(),
        )
    }
}

/// How far a rollout is from the recorded one.
#[derive(Debug, Default)]
struct Worst {
    state: f64,
    observation: f64,
    reward: f64,
    info: f64,
    pictures: [(f64, bool); 2],
}

fn follow_one<D: Domain>(file: &Path) -> Worst {
    let mut golden = Golden::open(file);
    let task = if golden.has("task") { golden.text("task") } else { D::NAMES[0].to_owned() };
    let registry = Registry { kind: "environment", hint: "", rows: &ENTRIES };
    let choice: EnvChoice = registry.choose(&format!("{},task={task}", D::ID)).expect("a world");
    let (spec, model, mut control) = parts::<D>(&choice).expect("a world");
    let factors = spec.variation_space.resolve(&golden.variation(), Key::new(0)).expect("possible values");
    let mut physics = Physics::new(Arc::clone(&model)).expect("a state");
    control.apply_factors(&mut physics, &factors).expect("a model");
    control.start(&mut physics, &factors, Key::new(0)).expect("a start");

    // The recorded start.
    let mut state = vec![];
    for name in
        ["time", "qpos", "qvel", "act", "qacc_warmstart", "ctrl", "eq_active"].map(|part| format!("start.{part}"))
    {
        if golden.has(&name) {
            state.extend(golden.numbers(&name));
        }
    }
    let mut memory = vec![0.0; control.task_state_len(&model)];
    control.save_task_state(&mut memory);
    memory[1..=D::TARGET].copy_from_slice(&target::<D>(&mut golden));
    control.load_task_state(&mut physics, &memory);
    physics.set_state(&state).expect("a state");
    physics.forward_passive();

    // As a world has its columns: two of the world's own, then the task's.
    let own = [ColumnSpec::new("state", DType::Float64, [1]), ColumnSpec::new("unstable", DType::Bool, [])];
    let columns: Vec<ColumnSpec> = own.into_iter().chain(spec.columns.clone()).collect();
    let row = Batch::zeros(&Schema::new(columns).expect("columns"), 1);
    let mut follower = Follower { physics, control, stage: None, row };

    let (actions, rewards, ends) = (golden.numbers("action"), golden.numbers("reward"), golden.numbers("terminated"));
    let (states, seen) = (golden.numbers("qpos_qvel"), golden.numbers("obs"));
    let infos: Vec<(&str, Vec<f64>)> =
        D::INFO.iter().map(|&(name, _)| (name, golden.numbers(&format!("info.{name}")))).collect();
    let mut worst = Worst::default();
    worst.pictures[0] = follower.picture(file, &mut golden, "frame_first");
    let n = spec.action_space.len();
    for t in 0..=rewards.len() {
        if t > 0 {
            let step = follower.control.hold(&mut follower.physics, actions[(t - 1) * n..t * n].iter().copied());
            worst.reward = worst.reward.max((step.reward - rewards[t - 1]).abs());
            assert_eq!(step.terminated, ends[t - 1] > 0.0, "{}, terminated {t}", file.display());
        }
        let mut now = follower.column("qpos");
        now.extend(follower.column("qvel"));
        worst.state = worst.state.max(apart(&now, &states[t * now.len()..][..now.len()]));
        let observation = follower.column("observation");
        let wanted = &seen[t * observation.len()..][..observation.len()];
        worst.observation = worst.observation.max(apart(&observation, wanted));
        for (name, recorded) in &infos {
            let info = follower.column(name);
            worst.info = worst.info.max(apart(&info, &recorded[t * info.len()..][..info.len()]));
        }
    }
    worst.pictures[1] = follower.picture(file, &mut golden, "frame_last");
    worst
}

/// Follows every rollout of a world.
#[allow(clippy::print_stderr, reason = "how far each is, for who asks with --nocapture")]
fn follow<D: Domain>() {
    let files = recorded::files(&format!("{}-", D::ID.replace('/', "_")));
    assert!(!files.is_empty(), "the files beside the tests are always there");
    let mut wrong = vec![];
    for file in files {
        let worst = follow_one::<D>(&file);
        let name = file.file_name().expect("a name").to_string_lossy().into_owned();
        eprintln!("{name}: {worst:?}");
        let numbers = worst.state.max(worst.observation).max(worst.reward).max(worst.info);
        if numbers > NEAR || worst.pictures.iter().any(|(egl, cpu)| *egl > ALIKE || !cpu) {
            wrong.push(format!("{name}: {worst:?}"));
        }
    }
    assert!(wrong.is_empty(), "rollouts that differ: {wrong:#?}");
}

macro_rules! follow {
    ($($name:ident $domain:ty;)*) => {$(
        #[test]
        fn $name() {
            follow::<$domain>();
        }
    )*};
}

follow! {
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
