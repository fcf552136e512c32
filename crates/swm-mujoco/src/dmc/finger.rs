//! Finger: a finger of two links rotates a body on a hinge (`dm_control/suite/finger.py`).

use super::domain::{Domain, InfoColumn, TaskTable, tasks};
use super::measures::norm;
use super::model_edit::ModelEdit;
use super::model_index::ModelIndex;
use super::observation::ObservationWriter;
use super::suite_env::entry;
use super::{factors, start};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry row of this domain.
pub const ENTRY: EnvEntry = entry::<Finger>(&[]);

/// The hinge velocity at which the body counts as spinning, in rad/s.
const SPIN_VELOCITY: f64 = -15.0;
/// Damping of the hinge in the spin task, in N m s/rad.
const SPIN_DAMPING: f64 = 0.03;

/// A task of the finger domain.
#[derive(Clone, Copy)]
pub enum Task {
    /// Turn the body's tip to a target of this radius, in metres.
    Turn(f64),
    /// Spin the body.
    Spin,
}

/// The indices of sensor values in `sensordata`.
struct Sensors {
    proximal: usize,
    distal: usize,
    velocities: [usize; 3],
    tip: usize,
    target: usize,
    spinner: usize,
    touch: [usize; 2],
}

/// The task and the indices of the domain's elements in the model.
pub struct Finger {
    task: Task,
    sensors: Sensors,
    target: usize,
    tip: usize,
    cap: usize,
    hinge: usize,
    hinge_velocity: usize,
}

impl Finger {
    /// A sensed position relative to the hinge, in the plane of the finger (x and z), in metres.
    fn relative_to_hinge(&self, physics: &Physics, sensor: usize) -> [f64; 2] {
        let values = physics.data().sensordata();
        [0, 2].map(|axis| values[sensor + axis] - values[self.sensors.spinner + axis])
    }

    /// The distance of the tip from the target's surface, in metres; negative inside.
    fn to_target(&self, physics: &Physics) -> f64 {
        let sensors = [self.sensors.tip, self.sensors.target];
        let [tip, target] = sensors.map(|sensor| self.relative_to_hinge(physics, sensor));
        norm(&[target[0] - tip[0], target[1] - tip[1]]) - physics.model().site_size()[self.target][0]
    }
}

impl Domain for Finger {
    type Task = Task;
    const ID: &'static str = "swm/FingerDMControl-v0";
    const SUMMARY: &'static str = "Turn a body on a hinge to a target with a finger, or spin it";
    const MODEL: &'static str = "finger.xml";
    const TASKS: TaskTable<Task> = tasks! {
        "turn_hard" => Task::Turn(0.03),
        "turn_easy" => Task::Turn(0.07),
        "spin" => Task::Spin,
    };
    const SUBSTEPS: usize = 2;
    const INFO: &'static [InfoColumn<Self>] = &[
        InfoColumn {
            name: "hinge_velocity",
            len: 1,
            write: |finger, physics, into| into[0] = physics.data().sensordata()[finger.sensors.velocities[2]],
        },
        InfoColumn {
            name: "target_position",
            len: 2,
            write: |finger, physics, into| {
                into.copy_from_slice(&finger.relative_to_hinge(physics, finger.sensors.target));
            },
        },
        InfoColumn {
            name: "tip_position",
            len: 2,
            write: |finger, physics, into| into.copy_from_slice(&finger.relative_to_hinge(physics, finger.sensors.tip)),
        },
    ];
    const TARGET_LEN: usize = 2;

    fn factors() -> Vec<Factor> {
        let mut all = vec![
            factors::agent_color(),
            factors::density("agent.fingertip_density"),
            factors::density("agent.proximal_density"),
            factors::floor_color(),
            factors::light(),
            factors::render_target(),
            factors::color("spinner.color", [0.7, 0.5, 0.3]),
            factors::density("spinner.density"),
            factors::scalar("spinner.friction", 0.0, 1.0, 0.1),
        ];
        all.extend(factors::target());
        all
    }

    fn edit(edit: &mut ModelEdit<'_>, task: Task) -> Result<()> {
        edit.common("light")?;
        edit.density("proximal", "agent.proximal_density")?;
        edit.density("fingertip", "agent.fingertip_density")?;
        for cap in ["cap1", "cap2"] {
            edit.density(cap, "spinner.density")?;
            edit.geom_color(cap, "spinner.color")?;
        }
        edit.joint_friction("hinge", "spinner.friction")?;
        edit.target_color()?;
        edit.target_site(match task {
            Task::Turn(radius) => radius,
            Task::Spin => 0.03,
        })
    }

    fn new(model: &MjModel, task: Task) -> Result<Self> {
        let index = ModelIndex(model);
        let sensors = Sensors {
            proximal: index.sensor("proximal")?,
            distal: index.sensor("distal")?,
            velocities: [
                index.sensor("proximal_velocity")?,
                index.sensor("distal_velocity")?,
                index.sensor("hinge_velocity")?,
            ],
            tip: index.sensor("tip")?,
            target: index.sensor("target")?,
            spinner: index.sensor("spinner")?,
            touch: [index.sensor("touchtop")?, index.sensor("touchbottom")?],
        };
        Ok(Self {
            task,
            sensors,
            target: index.site("target")?,
            tip: index.site("tip")?,
            cap: index.geom("cap1")?,
            hinge: index.joint("hinge")?,
            hinge_velocity: index.qvel("hinge")?,
        })
    }

    fn configure_model(&self, physics: &mut Physics) {
        let model = physics.model_mut();
        match self.task {
            Task::Turn(radius) => model.site_size_mut()[self.target][0] = radius,
            Task::Spin => {
                model.site_rgba_mut()[self.target][3] = 0.0;
                model.site_rgba_mut()[self.tip][3] = 0.0;
                model.dof_damping_mut()[self.hinge_velocity] = SPIN_DAMPING;
            }
        }
    }

    fn start(&self, physics: &mut Physics, rng: &mut Rng) -> Result<()> {
        if let Task::Turn(_) = self.task {
            let (sin, cos) = rng.random_range(-PI..PI).sin_cos();
            let hinge = physics.data().xanchor()[self.hinge];
            let reach = physics.model().geom_size()[self.cap].iter().sum::<f64>();
            self.set_target(physics, &[hinge[0] + reach * sin, hinge[2] + reach * cos]);
        }
        start::sample_without_contacts(physics, rng, start::randomize_joints)
    }

    fn target(&self, physics: &Physics, into: &mut [f64]) {
        let position = physics.model().site_pos()[self.target];
        into.copy_from_slice(&[position[0], position[2]]);
    }

    fn set_target(&self, physics: &mut Physics, target: &[f64]) {
        let position = &mut physics.model_mut().site_pos_mut()[self.target];
        (position[0], position[2]) = (target[0], target[1]);
    }

    fn observe(&self, physics: &Physics, observation: &mut ObservationWriter<'_>) {
        let values = physics.data().sensordata();
        observation.extend([values[self.sensors.proximal], values[self.sensors.distal]]);
        observation.extend(self.relative_to_hinge(physics, self.sensors.tip));
        observation.extend(self.sensors.velocities.map(|sensor| values[sensor]));
        observation.extend(self.sensors.touch.map(|sensor| values[sensor].ln_1p()));
        if let Task::Turn(_) = self.task {
            observation.extend(self.relative_to_hinge(physics, self.sensors.target));
            observation.push(self.to_target(physics));
        }
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let done = match self.task {
            Task::Turn(_) => self.to_target(physics) <= 0.0,
            Task::Spin => physics.data().sensordata()[self.sensors.velocities[2]] <= SPIN_VELOCITY,
        };
        f64::from(u8::from(done))
    }
}
