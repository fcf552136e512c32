//! A robot on four legs walks, runs, climbs out of a bowl, and fetches a ball.

use super::blueprint::{Edit, without};
use super::env::Seen;
use super::names::Names;
use super::reward::Tolerance;
use super::{Domain, entry, factors, norm, seen_from, task_names};
use crate::Physics;
use mujoco_rs::mujoco_c::{mjtJoint, mjtSensor};
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use rand_distr::StandardNormal;
use std::f64::consts::{PI, SQRT_2};
use swm_core::{EnvEntry, Error, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Quadruped>(&[]);

/// A torso is upright the more its z-axis points up.
const UPRIGHT: Tolerance = Tolerance::at_least(1.0).linear(2.0, 0.0);
/// Numbers of `qpos` that say where the torso is and how it is turned.
const ROOT: usize = 7;
/// How far apart the heights are at which a start is tried, in metres, and how many there are.
const RISE: f64 = 0.01;
const RISES: u32 = 10_000;

/// What there is to do.
#[derive(Clone, Copy)]
pub enum Task {
    /// Go forward at this speed, in m/s.
    Go(f64),
    /// Bring a ball to the middle.
    Fetch,
}

/// The places that the ball's task needs.
struct Fetch {
    ball: usize,
    ball_geom: usize,
    ball_position: usize,
    ball_velocity: usize,
    target: usize,
    workspace: usize,
    floor: usize,
}

pub struct Quadruped {
    task: Task,
    torso: usize,
    /// Where the coordinates and velocities of the legs' joints are.
    joints: Vec<[usize; 2]>,
    velocimeter: usize,
    /// Where the numbers of the gyroscope and the accelerometer are.
    inertial: Vec<usize>,
    /// Where the forces and torques at the toes are.
    forces: Vec<usize>,
    fetch: Option<Fetch>,
}

impl Quadruped {
    fn velocity(&self, physics: &Physics) -> [f64; 3] {
        std::array::from_fn(|axis| physics.data().sensordata()[self.velocimeter + axis])
    }

    fn upright(&self, physics: &Physics) -> f64 {
        physics.data().xmat()[self.torso][8]
    }

    /// Puts the robot to a place, as low as it touches nothing.
    fn stand(&self, physics: &mut Physics, [x, y]: [f64; 2], turn: [f64; 4]) -> Result<()> {
        for rise in 0..RISES {
            let root = &mut physics.data_mut().qpos_mut()[..ROOT];
            root[..3].copy_from_slice(&[x, y, f64::from(rise) * RISE]);
            root[3..].copy_from_slice(&turn);
            physics.forward_passive();
            if physics.data().contact().is_empty() && !physics.is_unstable() {
                return Ok(());
            }
        }
        let constraint = "free of contacts".to_owned();
        Err(Error::Unsatisfiable { factor: "the robot's height".to_owned(), constraint, tries: RISES as usize })
    }
}

impl Domain for Quadruped {
    type Task = Task;
    const ID: &'static str = "swm/QuadrupedDMControl-v0";
    const SUMMARY: &'static str = "Walk and run on four legs, or fetch a ball";
    const MODEL: &'static str = "quadruped.xml";
    const TASKS: &'static [(&'static str, Task)] =
        &[("walk", Task::Go(0.5)), ("run", Task::Go(5.0)), ("fetch", Task::Fetch)];
    const NAMES: &'static [&'static str] = &task_names::<_, 3>(Self::TASKS);
    const SUBSTEPS: usize = 4;
    const CAMERA: usize = 2;
    const INFO: &'static [(&'static str, usize)] = &[("torso_velocity", 3)];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::color("agent.color", [0.6, 0.3, 0.3]),
            factors::density("agent.foot_back_left_density"),
            factors::choice("agent.knee_back_left_locked", 1),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn draft(text: String, task: Task) -> Result<String> {
        let walls = ["wall_px", "wall_py", "wall_nx", "wall_ny"].map(|wall| ("geom", wall));
        let mut unused = vec![("geom", "terrain".to_owned())];
        if let Task::Go(_) = task {
            unused.extend(walls.map(|(tag, name)| (tag, name.to_owned())));
            unused.extend([("body", "ball".to_owned()), ("site", "target".to_owned())]);
        }
        unused.extend((0..20).map(|i| ("rangefinder", format!("rf_{}{}", i / 5, i % 5))));
        unused.iter().try_fold(text, |text, (tag, name)| without(&text, tag, name))
    }

    fn edit(edit: &mut Edit<'_>, task: Task) -> Result<()> {
        if let Task::Go(speed) = task {
            // As far as one comes in twenty seconds.
            edit.floor_size("floor", 20.0 * speed)?;
        }
        edit.scene("light")?;
        edit.gravity();
        edit.friction("floor")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("foot_back_left", "agent.foot_back_left_density")
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let names = Names(model);
        let joints = (0..model.jnt_type().len()).filter(|&joint| model.jnt_type()[joint] == mjtJoint::mjJNT_HINGE);
        let numbers = |wanted: [mjtSensor; 2]| {
            let kinds = model.sensor_type().iter().enumerate().filter(|(_, kind)| wanted.contains(kind));
            let places =
                kinds.map(|(sensor, _)| (model.sensor_adr()[sensor] as usize, model.sensor_dim()[sensor] as usize));
            places.flat_map(|(begin, n)| begin..begin + n).collect()
        };
        let fetch = match task {
            Task::Go(_) => None,
            Task::Fetch => Some(Fetch {
                ball: names.body("ball")?,
                ball_geom: names.geom("ball")?,
                ball_position: names.position("ball_root")?,
                ball_velocity: names.velocity("ball_root")?,
                target: names.site("target")?,
                workspace: names.site("workspace")?,
                floor: names.geom("floor")?,
            }),
        };
        Ok(Self {
            task,
            torso: names.body("torso")?,
            joints: joints
                .map(|joint| [model.jnt_qposadr()[joint] as usize, model.jnt_dofadr()[joint] as usize])
                .collect(),
            velocimeter: names.sensor("velocimeter")?,
            inertial: numbers([mjtSensor::mjSENS_GYRO, mjtSensor::mjSENS_ACCELEROMETER]),
            forces: numbers([mjtSensor::mjSENS_FORCE, mjtSensor::mjSENS_TORQUE]),
            fetch,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        let Some(fetch) = &self.fetch else {
            let turn: [f64; 4] = std::array::from_fn(|_| rng.sample(StandardNormal));
            let length = norm(&turn);
            return self.stand(physics, [0.0; 2], turn.map(|number| number / length));
        };
        let (sin, cos) = (rng.random_range(0.0..2.0 * PI) / 2.0f64).sin_cos();
        let radius = 0.9 * physics.model().geom_size()[fetch.floor][0];
        let mut place = || rng.random_range(-radius..radius);
        let (robot, ball) = ([place(), place()], [place(), place()]);
        self.stand(physics, robot, [cos, 0.0, 0.0, sin])?;
        let data = physics.data_mut();
        data.qpos_mut()[fetch.ball_position..][..3].copy_from_slice(&[ball[0], ball[1], 2.0]);
        for speed in &mut data.qvel_mut()[fetch.ball_velocity..][..2] {
            *speed = 5.0 * rng.sample::<f64, _>(StandardNormal);
        }
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        let data = physics.data();
        seen.extend(self.joints.iter().map(|&[position, _]| data.qpos()[position]));
        seen.extend(self.joints.iter().map(|&[_, velocity]| data.qvel()[velocity]));
        seen.extend(data.act());
        seen.extend(self.velocity(physics));
        seen.push(self.upright(physics));
        seen.extend(self.inertial.iter().map(|&at| data.sensordata()[at]));
        seen.extend(self.forces.iter().map(|&at| data.sensordata()[at].asinh()));
        if let Some(fetch) = &self.fetch {
            let (frame, torso) = (&data.xmat()[self.torso], data.xpos()[self.torso]);
            let from_torso = |place: [f64; 3]| seen_from(frame, std::array::from_fn(|axis| place[axis] - torso[axis]));
            let speed = &data.qvel()[fetch.ball_velocity..];
            seen.extend(from_torso(data.xpos()[fetch.ball]));
            seen.extend(seen_from(frame, std::array::from_fn(|axis| speed[axis] - data.qvel()[axis])));
            seen.extend(seen_from(frame, std::array::from_fn(|axis| speed[3 + axis])));
            seen.extend(from_torso(data.site_xpos()[fetch.target]));
        }
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let upright = UPRIGHT.of(self.upright(physics));
        let Some(fetch) = &self.fetch else {
            let Task::Go(speed) = self.task else { return 0.0 };
            return upright * Tolerance::at_least(speed).linear(speed, 0.5).of(self.velocity(physics)[0]);
        };
        let (model, data) = (physics.model(), physics.data());
        let ball = data.xpos()[fetch.ball];
        let beside = |site: usize| norm(&[0, 1].map(|axis| data.site_xpos()[site][axis] - ball[axis]));
        let arena = model.geom_size()[fetch.floor][0] * SQRT_2;
        let within = |radius: f64| Tolerance::within(0.0, radius).linear(arena, 0.0);
        let reach = model.site_size()[fetch.workspace][0] + model.geom_size()[fetch.ball_geom][0];
        let reached = within(reach).of(beside(fetch.workspace));
        let fetched = within(model.site_size()[fetch.target][0]).of(beside(fetch.target));
        upright * reached * (0.5 + 0.5 * fetched)
    }

    fn info(&self, physics: &Physics, _column: usize, into: &mut [f64]) {
        into.copy_from_slice(&self.velocity(physics));
    }
}
