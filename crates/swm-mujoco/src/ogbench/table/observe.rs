//! The columns of a table: the observation, and the state of every object. Names and scales are those of the reference.

use super::config::observation_len;
use super::objects::Fixtures;
use super::task::{TASK_STATE_HEAD, Table};
use crate::Physics;
use crate::ogbench::arm::CONTROLS;
use crate::ogbench::arm::ik::JOINTS;
use crate::ogbench::arm::pose::{Vec3, yaw, yaw_of_matrix};
use crate::physics::state_len;
use crate::task::{FIRST_TASK_COLUMN, Task as _};
use mujoco_rs::wrappers::MjModel;
use swm_core::columns::GOAL_STATE;
use swm_core::{ColumnSpec, DType, RowMut};

/// The origin of positions in an observation, in metres.
const CENTER: Vec3 = [0.425, 0.0, 0.0];
// Scales of the quantities in an observation.
const POSITION_SCALE: f64 = 10.0;
const GRIPPER_SCALE: f64 = 3.0;
const BUTTON_SCALE: f64 = 120.0;
const DRAWER_SCALE: f64 = 18.0;
const WINDOW_SCALE: f64 = 15.0;

/// Writes an observation element by element.
struct ObservationWriter<'a> {
    into: &'a mut [f64],
    next: usize,
}

impl ObservationWriter<'_> {
    fn write(&mut self, values: &[f64]) {
        self.into[self.next..self.next + values.len()].copy_from_slice(values);
        self.next += values.len();
    }

    fn position(&mut self, position: Vec3) {
        self.write(&std::array::from_fn::<f64, 3, _>(|i| (position[i] - CENTER[i]) * POSITION_SCALE));
    }

    fn angle(&mut self, angle: f64) {
        self.write(&[angle.cos(), angle.sin()]);
    }
}

/// Fills columns one after another, from [`FIRST_TASK_COLUMN`] on.
struct ColumnWriter<'a, 'b> {
    row: &'a mut RowMut<'b>,
    next: usize,
}

impl ColumnWriter<'_, '_> {
    fn set(&mut self, values: &[f64]) {
        self.row.set(self.next, values);
        self.next += 1;
    }

    fn integers(&mut self, values: &[i64]) {
        self.row.set(self.next, values);
        self.next += 1;
    }
}

impl Table {
    /// The columns of this table.
    pub(super) fn columns(&self, model: &MjModel) -> Vec<ColumnSpec> {
        let state = state_len(model) + self.task_state_len(model);
        let (nq, nv) = (model.qpos0().len(), model.dof_damping().len());
        let observation = observation_len(self.config.cubes, self.config.fixtures);
        let mut columns = vec![];
        let mut float = |name: &str, n: usize| columns.push(ColumnSpec::new(name, DType::Float64, [n]));
        float("observation", observation);
        float(GOAL_STATE, state);
        float("proprio/joint_pos", JOINTS);
        float("proprio/joint_vel", JOINTS);
        float("proprio/effector_pos", 3);
        for name in ["effector_yaw", "gripper_opening", "gripper_vel", "gripper_contact"] {
            float(&format!("proprio/{name}"), 1);
        }
        for cube in 0..self.config.cubes {
            float(&format!("privileged/block_{cube}_pos"), 3);
            float(&format!("privileged/block_{cube}_quat"), 4);
            float(&format!("privileged/block_{cube}_yaw"), 1);
        }
        float("prev_qpos", nq);
        float("prev_qvel", nv);
        float("qpos", nq);
        float("qvel", nv);
        float("control", CONTROLS);
        float("time", 1);
        float("target", observation);
        float("goal/block_pos", 3 * self.config.cubes);
        float("goal/block_yaw", self.config.cubes);
        columns.push(ColumnSpec::new("goal/subject", DType::Int64, []));
        if self.config.fixtures {
            let mut float = |name: &str, n: usize| columns.push(ColumnSpec::new(name, DType::Float64, [n]));
            for button in 0..2 {
                float(&format!("privileged/button_{button}_pos"), 1);
                float(&format!("privileged/button_{button}_vel"), 1);
                float(&format!("privileged/button_{button}_top_pos"), 3);
            }
            for name in ["drawer", "window"] {
                float(&format!("privileged/{name}_pos"), 1);
                float(&format!("privileged/{name}_vel"), 1);
                float(&format!("privileged/{name}_handle_pos"), 3);
                float(&format!("privileged/{name}_handle_yaw"), 1);
            }
            float("goal/drawer_pos", 1);
            float("goal/window_pos", 1);
            for name in ["button_states", "prev_button_states", "goal/button_states"] {
                columns.push(ColumnSpec::new(name, DType::Int64, [2]));
            }
            for button in 0..2 {
                columns.push(ColumnSpec::new(format!("privileged/button_{button}_state"), DType::Int64, []));
            }
        }
        columns
    }

    /// Writes the observation.
    pub(super) fn observation(&self, physics: &Physics, into: &mut [f64]) {
        let (data, gripper) = (physics.data(), self.proprioception(physics));
        let mut writer = ObservationWriter { into, next: 0 };
        writer.write(&data.qpos()[..JOINTS]);
        writer.write(&data.qvel()[..JOINTS]);
        writer.position(gripper.position);
        writer.angle(gripper.yaw);
        writer.write(&[gripper.closed * GRIPPER_SCALE, gripper.contact]);
        for cube in &self.objects.cubes {
            let rotation = cube.rotation(data.qpos());
            writer.position(cube.position(data.qpos()));
            writer.write(&rotation);
            writer.angle(yaw(rotation));
        }
        if let Some(fixtures) = &self.objects.fixtures {
            for (button, state) in fixtures.buttons.iter().zip(self.buttons) {
                let unlocked = f64::from(state);
                let (at, speed) = (data.qpos()[button.slide.qpos], data.qvel()[button.slide.qvel]);
                writer.write(&[1.0 - unlocked, unlocked, at * BUTTON_SCALE, speed]);
            }
            for (sliding, scale) in [(fixtures.drawer, DRAWER_SCALE), (fixtures.window, WINDOW_SCALE)] {
                writer.write(&[data.qpos()[sliding.slide.qpos] * scale, data.qvel()[sliding.slide.qvel]]);
            }
        }
    }

    /// Writes the goal in the layout of the `state` column: the present state with the goal's pose and locks.
    fn write_goal(&self, physics: &Physics, into: &mut [f64]) {
        let (state, task_state) = into.split_at_mut(physics.state_len());
        physics.state(state);
        state[1..=self.goal.pose.len()].copy_from_slice(&self.goal.pose);
        let [a, b] = self.goal.fixtures.buttons.map(f64::from);
        let (head, previous) = task_state.split_at_mut(TASK_STATE_HEAD);
        head.copy_from_slice(&[self.goal.contact, a, b, a, b]);
        previous.copy_from_slice(&self.goal.pose);
    }

    /// Writes all columns.
    pub(super) fn write(&self, physics: &Physics, row: &mut RowMut<'_>) {
        let (data, gripper) = (physics.data(), self.proprioception(physics));
        let (qpos, qvel) = (data.qpos(), data.qvel());
        self.observation(physics, row.at::<f64>(FIRST_TASK_COLUMN));
        self.write_goal(physics, row.at::<f64>(FIRST_TASK_COLUMN + 1));
        let mut columns = ColumnWriter { row, next: FIRST_TASK_COLUMN + 2 };
        columns.set(&qpos[..JOINTS]);
        columns.set(&qvel[..JOINTS]);
        columns.set(&gripper.position);
        for value in [gripper.yaw, gripper.closed, gripper.closing, gripper.contact] {
            columns.set(&[value]);
        }
        for cube in &self.objects.cubes {
            let rotation = cube.rotation(qpos);
            columns.set(&cube.position(qpos));
            columns.set(&rotation);
            columns.set(&[yaw(rotation)]);
        }
        let (previous_qpos, previous_qvel) = self.previous.split_at(qpos.len());
        columns.set(previous_qpos);
        columns.set(previous_qvel);
        columns.set(qpos);
        columns.set(qvel);
        columns.set(data.ctrl());
        columns.set(&[data.time()]);
        columns.set(&self.goal.observation);
        let positions = columns.row.at::<f64>(columns.next);
        for ((position, _), into) in self.goal.cubes.iter().zip(positions.chunks_exact_mut(3)) {
            into.copy_from_slice(position);
        }
        let yaws = columns.row.at::<f64>(columns.next + 1);
        for ((_, rotation), into) in self.goal.cubes.iter().zip(yaws) {
            *into = yaw(*rotation);
        }
        columns.next += 2;
        columns.integers(&[self.goal.subject.code()]);
        if let Some(fixtures) = &self.objects.fixtures {
            self.write_fixtures(physics, fixtures, &mut columns);
        }
    }

    /// Writes the columns about buttons, drawer and window.
    fn write_fixtures(&self, physics: &Physics, fixtures: &Fixtures, columns: &mut ColumnWriter<'_, '_>) {
        let data = physics.data();
        let (qpos, qvel) = (data.qpos(), data.qvel());
        for button in fixtures.buttons {
            columns.set(&[qpos[button.slide.qpos]]);
            columns.set(&[qvel[button.slide.qvel]]);
            columns.set(&data.site_xpos()[button.top]);
        }
        for sliding in [fixtures.drawer, fixtures.window] {
            columns.set(&[qpos[sliding.slide.qpos]]);
            columns.set(&[qvel[sliding.slide.qvel]]);
            columns.set(&data.site_xpos()[sliding.handles[0]]);
            columns.set(&[yaw_of_matrix(&data.site_xmat()[sliding.handles[0]])]);
        }
        columns.set(&[self.goal.fixtures.drawer]);
        columns.set(&[self.goal.fixtures.window]);
        for states in [self.buttons, self.previous_buttons, self.goal.fixtures.buttons] {
            columns.integers(&states.map(i64::from));
        }
        for state in self.buttons {
            columns.integers(&[i64::from(state)]);
        }
    }
}
