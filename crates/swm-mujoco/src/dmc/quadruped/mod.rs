//! Quadruped: a four-legged robot walks, runs, and fetches a ball (`dm_control/suite/quadruped.py`).

mod expert;

use super::domain::{Domain, InfoColumn, TaskTable, tasks};
use super::factors;
use super::measures::{in_frame, norm, uprightness};
use super::model_edit::ModelEdit;
use super::model_index::ModelIndex;
use super::model_source::without_element;
use super::observation::ObservationWriter;
use super::reward::Tolerance;
use super::suite_env::entry;
use crate::Physics;
use mujoco_rs::mujoco_c::{mjtJoint, mjtSensor};
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use rand_distr::StandardNormal;
use std::f64::consts::{PI, SQRT_2};
use swm_core::{EnvEntry, Error, Factor, Result, Rng};

/// The registry row of this domain.
pub const ENTRY: EnvEntry = entry::<Quadruped>(expert::EXPERTS);

/// Indicator of an upright torso, by the vertical component of its z-axis.
const UPRIGHT: Tolerance = Tolerance::at_least(1.0).linear(2.0, 0.0);
/// The number of elements of `qpos` for position and orientation of the torso.
const ROOT_LEN: usize = 7;
/// The step between the heights at which a start is tried, in metres.
const HEIGHT_STEP: f64 = 0.01;
/// The maximal number of heights at which a start is tried.
const HEIGHT_TRIES: u32 = 10_000;

/// A task of the quadruped domain.
#[derive(Clone, Copy)]
pub enum Task {
    /// Move forward at this speed, in m/s.
    Move(f64),
    /// Bring a ball to the centre.
    Fetch,
}

/// The indices that only the fetch task uses.
struct Fetch {
    ball: usize,
    ball_geom: usize,
    ball_position: usize,
    ball_velocity: usize,
    target: usize,
    workspace: usize,
    floor: usize,
}

/// The task and the indices of the domain's elements in the model.
pub struct Quadruped {
    task: Task,
    torso: usize,
    /// `qpos` and `qvel` indices of the legs' joints.
    joints: Vec<[usize; 2]>,
    velocimeter: usize,
    /// `sensordata` indices of gyroscope and accelerometer.
    inertial: Vec<usize>,
    /// `sensordata` indices of forces and torques at the toes.
    forces: Vec<usize>,
    fetch: Option<Fetch>,
}

impl Quadruped {
    /// The velocity of the torso in its own frame, in m/s.
    fn velocity(&self, physics: &Physics) -> [f64; 3] {
        std::array::from_fn(|axis| physics.data().sensordata()[self.velocimeter + axis])
    }

    /// Places the robot at a horizontal position (m), at the lowest height without contacts.
    fn place_above_floor(&self, physics: &mut Physics, [x, y]: [f64; 2], quat: [f64; 4]) -> Result<()> {
        for i in 0..HEIGHT_TRIES {
            let root = &mut physics.data_mut().qpos_mut()[..ROOT_LEN];
            root[..3].copy_from_slice(&[x, y, f64::from(i) * HEIGHT_STEP]);
            root[3..].copy_from_slice(&quat);
            physics.forward_passive();
            if physics.data().contact().is_empty() && !physics.is_unstable() {
                return Ok(());
            }
        }
        let constraint = "free of contacts".to_owned();
        Err(Error::Unsatisfiable { factor: "the robot's height".to_owned(), constraint, tries: HEIGHT_TRIES as usize })
    }
}

impl Domain for Quadruped {
    type Task = Task;
    const ID: &'static str = "swm/QuadrupedDMControl-v0";
    const SUMMARY: &'static str = "Walk and run on four legs, or fetch a ball";
    const MODEL: &'static str = "quadruped.xml";
    const TASKS: TaskTable<Task> =
        tasks! { "walk" => Task::Move(0.5), "run" => Task::Move(5.0), "fetch" => Task::Fetch };
    const SUBSTEPS: usize = 4;
    const CAMERA: usize = 2;
    const INFO: &'static [InfoColumn<Self>] = &[InfoColumn {
        name: "torso_velocity",
        len: 3,
        write: |quadruped, physics, into| into.copy_from_slice(&quadruped.velocity(physics)),
    }];

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::color("agent.color", [0.6, 0.3, 0.3]),
            factors::density("agent.foot_back_left_density"),
            factors::binary("agent.knee_back_left_locked", 1),
            factors::density("agent.torso_density"),
            factors::floor_color(),
            factors::floor_friction(),
        ];
        all.extend(factors::gravity());
        all.push(factors::light());
        all
    }

    fn prepare_xml(text: String, task: Task) -> Result<String> {
        let walls = ["wall_px", "wall_py", "wall_nx", "wall_ny"].map(|wall| ("geom", wall));
        let mut unused = vec![("geom", "terrain".to_owned())];
        if let Task::Move(_) = task {
            unused.extend(walls.map(|(tag, name)| (tag, name.to_owned())));
            unused.extend([("body", "ball".to_owned()), ("site", "target".to_owned())]);
        }
        unused.extend((0..20).map(|i| ("rangefinder", format!("rf_{}{}", i / 5, i % 5))));
        unused.iter().try_fold(text, |text, (tag, name)| without_element(&text, tag, name))
    }

    fn edit(edit: &mut ModelEdit<'_>, task: Task) -> Result<()> {
        if let Task::Move(speed) = task {
            // Half a side is the distance covered in 20 seconds at this speed, as in the suite.
            edit.floor_size("floor", 20.0 * speed)?;
        }
        edit.common("light")?;
        edit.gravity();
        edit.floor_friction("floor")?;
        edit.density("torso", "agent.torso_density")?;
        edit.density("foot_back_left", "agent.foot_back_left_density")
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let index = ModelIndex(model);
        let joints = (0..model.jnt_type().len()).filter(|&joint| model.jnt_type()[joint] == mjtJoint::mjJNT_HINGE);
        let values_of = |kinds: [mjtSensor; 2]| {
            let sensors = model.sensor_type().iter().enumerate().filter(|(_, kind)| kinds.contains(kind));
            let ranges =
                sensors.map(|(sensor, _)| (model.sensor_adr()[sensor] as usize, model.sensor_dim()[sensor] as usize));
            ranges.flat_map(|(begin, n)| begin..begin + n).collect()
        };
        let fetch = match task {
            Task::Move(_) => None,
            Task::Fetch => Some(Fetch {
                ball: index.body("ball")?,
                ball_geom: index.geom("ball")?,
                ball_position: index.qpos("ball_root")?,
                ball_velocity: index.qvel("ball_root")?,
                target: index.site("target")?,
                workspace: index.site("workspace")?,
                floor: index.geom("floor")?,
            }),
        };
        Ok(Self {
            task,
            torso: index.body("torso")?,
            joints: joints
                .map(|joint| [model.jnt_qposadr()[joint] as usize, model.jnt_dofadr()[joint] as usize])
                .collect(),
            velocimeter: index.sensor("velocimeter")?,
            inertial: values_of([mjtSensor::mjSENS_GYRO, mjtSensor::mjSENS_ACCELEROMETER]),
            forces: values_of([mjtSensor::mjSENS_FORCE, mjtSensor::mjSENS_TORQUE]),
            fetch,
        })
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        let Some(fetch) = &self.fetch else {
            let quat: [f64; 4] = std::array::from_fn(|_| rng.sample(StandardNormal));
            let length = norm(&quat);
            return self.place_above_floor(physics, [0.0; 2], quat.map(|value| value / length));
        };
        let (sin, cos) = (rng.random_range(0.0..2.0 * PI) / 2.0f64).sin_cos();
        let radius = 0.9 * physics.model().geom_size()[fetch.floor][0];
        let mut coordinate = || rng.random_range(-radius..radius);
        let (robot, ball) = ([coordinate(), coordinate()], [coordinate(), coordinate()]);
        self.place_above_floor(physics, robot, [cos, 0.0, 0.0, sin])?;
        let data = physics.data_mut();
        data.qpos_mut()[fetch.ball_position..][..3].copy_from_slice(&[ball[0], ball[1], 2.0]);
        for speed in &mut data.qvel_mut()[fetch.ball_velocity..][..2] {
            *speed = 5.0 * rng.sample::<f64, _>(StandardNormal);
        }
        physics.forward_passive();
        Ok(())
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        let data = physics.data();
        observation.extend(self.joints.iter().map(|&[position, _]| data.qpos()[position]));
        observation.extend(self.joints.iter().map(|&[_, velocity]| data.qvel()[velocity]));
        observation.extend(data.act());
        observation.extend(self.velocity(physics));
        observation.push(uprightness(physics, self.torso));
        observation.extend(self.inertial.iter().map(|&at| data.sensordata()[at]));
        observation.extend(self.forces.iter().map(|&at| data.sensordata()[at].asinh()));
        if let Some(fetch) = &self.fetch {
            let (frame, torso) = (&data.xmat()[self.torso], data.xpos()[self.torso]);
            let from_torso = |point: [f64; 3]| in_frame(frame, std::array::from_fn(|axis| point[axis] - torso[axis]));
            let speed = &data.qvel()[fetch.ball_velocity..];
            observation.extend(from_torso(data.xpos()[fetch.ball]));
            observation.extend(in_frame(frame, std::array::from_fn(|axis| speed[axis] - data.qvel()[axis])));
            observation.extend(in_frame(frame, std::array::from_fn(|axis| speed[3 + axis])));
            observation.extend(from_torso(data.site_xpos()[fetch.target]));
        }
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let upright = UPRIGHT.of(uprightness(physics, self.torso));
        let Some(fetch) = &self.fetch else {
            let Task::Move(speed) = self.task else { return 0.0 };
            return upright * Tolerance::at_least(speed).linear(speed, 0.5).of(self.velocity(physics)[0]);
        };
        let (model, data) = (physics.model(), physics.data());
        let ball = data.xpos()[fetch.ball];
        let ball_distance = |site: usize| norm(&[0, 1].map(|axis| data.site_xpos()[site][axis] - ball[axis]));
        let arena = model.geom_size()[fetch.floor][0] * SQRT_2;
        let within = |radius: f64| Tolerance::within(0.0, radius).linear(arena, 0.0);
        let reach = model.site_size()[fetch.workspace][0] + model.geom_size()[fetch.ball_geom][0];
        let reached = within(reach).of(ball_distance(fetch.workspace));
        let fetched = within(model.site_size()[fetch.target][0]).of(ball_distance(fetch.target));
        upright * reached * (0.5 + 0.5 * fetched)
    }
}
