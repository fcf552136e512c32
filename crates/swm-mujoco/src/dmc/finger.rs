//! A finger of two links turns a body on a hinge.

use super::blueprint::Edit;
use super::env::Seen;
use super::names::Names;
use super::{Domain, entry, factors, norm, start, task_names};
use crate::Physics;
use mujoco_rs::wrappers::MjModel;
use rand::Rng as _;
use std::f64::consts::PI;
use swm_core::{EnvEntry, Factor, Result, Rng};

/// The registry's row.
pub const ENTRY: EnvEntry = entry::<Finger>(&[]);

/// The hinge speed that counts as spinning, in rad/s: backwards.
const SPINNING: f64 = -15.0;
/// How much a hinge resists that is to be spun.
const SPIN_DAMPING: f64 = 0.03;

/// What there is to do.
#[derive(Clone, Copy)]
pub enum Task {
    /// Turn the body's tip to a target of this radius, in metres.
    Turn(f64),
    /// Spin it.
    Spin,
}

/// Where the numbers of a sensor begin.
struct Sensors {
    proximal: usize,
    distal: usize,
    velocities: [usize; 3],
    tip: usize,
    target: usize,
    spinner: usize,
    touch: [usize; 2],
}

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
    /// A place beside the hinge, in the plane of the finger.
    fn beside_hinge(&self, physics: &Physics, sensor: usize) -> [f64; 2] {
        let read = physics.data().sensordata();
        [0, 2].map(|axis| read[sensor + axis] - read[self.sensors.spinner + axis])
    }

    /// How far the tip is from the target's surface; negative inside.
    fn to_target(&self, physics: &Physics) -> f64 {
        let [tip, target] = [self.sensors.tip, self.sensors.target].map(|sensor| self.beside_hinge(physics, sensor));
        norm(&[target[0] - tip[0], target[1] - tip[1]]) - physics.model().site_size()[self.target][0]
    }
}

impl Domain for Finger {
    type Task = Task;
    const ID: &'static str = "swm/FingerDMControl-v0";
    const SUMMARY: &'static str = "Turn a body on a hinge with a finger, to a target or ever faster";
    const MODEL: &'static str = "finger.xml";
    const TASKS: &'static [(&'static str, Task)] =
        &[("turn_hard", Task::Turn(0.03)), ("turn_easy", Task::Turn(0.07)), ("spin", Task::Spin)];
    const NAMES: &'static [&'static str] = &task_names::<_, 3>(Self::TASKS);
    const SUBSTEPS: usize = 2;
    const INFO: &'static [(&'static str, usize)] =
        &[("hinge_velocity", 1), ("target_position", 2), ("tip_position", 2)];
    const TARGET: usize = 2;

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
            factors::number("spinner.friction", 0.0, 1.0, 0.1),
        ];
        all.extend(factors::target());
        all
    }

    fn edit(edit: &mut Edit<'_>, task: Task) -> Result<()> {
        edit.scene("light")?;
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
        let names = Names(model);
        let sensors = Sensors {
            proximal: names.sensor("proximal")?,
            distal: names.sensor("distal")?,
            velocities: [
                names.sensor("proximal_velocity")?,
                names.sensor("distal_velocity")?,
                names.sensor("hinge_velocity")?,
            ],
            tip: names.sensor("tip")?,
            target: names.sensor("target")?,
            spinner: names.sensor("spinner")?,
            touch: [names.sensor("touchtop")?, names.sensor("touchbottom")?],
        };
        Ok(Self {
            task,
            sensors,
            target: names.site("target")?,
            tip: names.site("tip")?,
            cap: names.geom("cap1")?,
            hinge: names.joint("hinge")?,
            hinge_velocity: names.velocity("hinge")?,
        })
    }

    fn adapt(&self, physics: &mut Physics) {
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
            self.place(physics, &[hinge[0] + reach * sin, hinge[2] + reach * cos]);
        }
        start::without_contacts(physics, rng, start::random_joints)
    }

    fn target(&self, physics: &Physics, into: &mut [f64]) {
        let place = physics.model().site_pos()[self.target];
        into.copy_from_slice(&[place[0], place[2]]);
    }

    fn place(&self, physics: &mut Physics, target: &[f64]) {
        let place = &mut physics.model_mut().site_pos_mut()[self.target];
        (place[0], place[2]) = (target[0], target[1]);
    }

    fn observe(&self, physics: &Physics, seen: &mut Seen<'_>) {
        let read = physics.data().sensordata();
        seen.extend([read[self.sensors.proximal], read[self.sensors.distal]]);
        seen.extend(self.beside_hinge(physics, self.sensors.tip));
        seen.extend(self.sensors.velocities.map(|sensor| read[sensor]));
        seen.extend(self.sensors.touch.map(|sensor| read[sensor].ln_1p()));
        if let Task::Turn(_) = self.task {
            seen.extend(self.beside_hinge(physics, self.sensors.target));
            seen.push(self.to_target(physics));
        }
    }

    fn reward(&self, physics: &Physics) -> f64 {
        let done = match self.task {
            Task::Turn(_) => self.to_target(physics) <= 0.0,
            Task::Spin => physics.data().sensordata()[self.sensors.velocities[2]] <= SPINNING,
        };
        f64::from(u8::from(done))
    }

    fn info(&self, physics: &Physics, column: usize, into: &mut [f64]) {
        match column {
            0 => into[0] = physics.data().sensordata()[self.sensors.velocities[2]],
            1 => into.copy_from_slice(&self.beside_hinge(physics, self.sensors.target)),
            _ => into.copy_from_slice(&self.beside_hinge(physics, self.sensors.tip)),
        }
    }
}
