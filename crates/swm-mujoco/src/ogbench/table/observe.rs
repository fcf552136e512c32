//! What one is told about a table: the observation, and columns of everything in it. Names and scales are the
//! reference's.

use super::{MEMORY, Table};
use crate::Physics;
use crate::ogbench::arm::CONTROLS;
use crate::ogbench::arm::ik::JOINTS;
use crate::ogbench::arm::pose::{Vec3, yaw, yaw_of_matrix};
use crate::physics::state_len;
use crate::task::{FIRST_TASK_COLUMN, Task as _};
use mujoco_rs::wrappers::MjModel;
use swm_core::{ColumnSpec, DType, RowMut};

/// Where positions are 0 in an observation, and by what numbers are multiplied there.
const CENTER: Vec3 = [0.425, 0.0, 0.0];
const PLACE_SCALE: f64 = 10.0;
const GRIPPER_SCALE: f64 = 3.0;
const BUTTON_SCALE: f64 = 120.0;
const DRAWER_SCALE: f64 = 18.0;
const WINDOW_SCALE: f64 = 15.0;

/// Numbers of an observation: the arm, every cube, and the fixtures.
pub const fn observation_len(cubes: usize, fixtures: bool) -> usize {
    19 + 9 * cubes + if fixtures { 12 } else { 0 }
}

/// Writes numbers one after the other.
struct Pen<'a> {
    into: &'a mut [f64],
    at: usize,
}

impl Pen<'_> {
    fn write(&mut self, numbers: &[f64]) {
        self.into[self.at..self.at + numbers.len()].copy_from_slice(numbers);
        self.at += numbers.len();
    }

    fn place(&mut self, place: Vec3) {
        self.write(&std::array::from_fn::<f64, 3, _>(|i| (place[i] - CENTER[i]) * PLACE_SCALE));
    }

    fn angle(&mut self, angle: f64) {
        self.write(&[angle.cos(), angle.sin()]);
    }
}

/// Fills columns one after the other, from [`FIRST_TASK_COLUMN`] on.
struct Columns<'a, 'b> {
    row: &'a mut RowMut<'b>,
    next: usize,
}

impl Columns<'_, '_> {
    fn set(&mut self, numbers: &[f64]) {
        self.row.set(self.next, numbers);
        self.next += 1;
    }

    fn integers(&mut self, numbers: &[i64]) {
        self.row.set(self.next, numbers);
        self.next += 1;
    }
}

impl Table {
    /// The columns of this table on this model.
    pub(super) fn columns(&self, model: &MjModel) -> Vec<ColumnSpec> {
        let state = state_len(model) + self.task_state_len(model);
        let (nq, nv) = (model.qpos0().len(), model.dof_damping().len());
        let observation = observation_len(self.setup.cubes, self.setup.fixtures);
        let mut columns = vec![];
        let mut float = |name: &str, n: usize| columns.push(ColumnSpec::new(name, DType::Float64, [n]));
        float("observation", observation);
        float("goal_state", state);
        float("proprio/joint_pos", JOINTS);
        float("proprio/joint_vel", JOINTS);
        float("proprio/effector_pos", 3);
        for name in ["effector_yaw", "gripper_opening", "gripper_vel", "gripper_contact"] {
            float(&format!("proprio/{name}"), 1);
        }
        for cube in 0..self.setup.cubes {
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
        float("goal/block_pos", 3 * self.setup.cubes);
        float("goal/block_yaw", self.setup.cubes);
        columns.push(ColumnSpec::new("goal/subject", DType::Int64, []));
        if self.setup.fixtures {
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
        let (data, feel) = (physics.data(), self.arm.feel(physics, self.contact));
        let mut pen = Pen { into, at: 0 };
        pen.write(&data.qpos()[..JOINTS]);
        pen.write(&data.qvel()[..JOINTS]);
        pen.place(feel.place);
        pen.angle(feel.yaw);
        pen.write(&[feel.closed * GRIPPER_SCALE, feel.contact]);
        for cube in &self.parts.cubes {
            let turn = cube.turn(data.qpos());
            pen.place(cube.place(data.qpos()));
            pen.write(&turn);
            pen.angle(yaw(turn));
        }
        if let Some(fixtures) = &self.parts.fixtures {
            for (button, state) in fixtures.buttons.iter().zip(self.buttons) {
                let unlocked = f64::from(state);
                let (at, speed) = (data.qpos()[button.slide.qpos], data.qvel()[button.slide.qvel]);
                pen.write(&[1.0 - unlocked, unlocked, at * BUTTON_SCALE, speed]);
            }
            for (sliding, scale) in [(fixtures.drawer, DRAWER_SCALE), (fixtures.window, WINDOW_SCALE)] {
                pen.write(&[data.qpos()[sliding.slide.qpos] * scale, data.qvel()[sliding.slide.qvel]]);
            }
        }
    }

    /// Writes the goal in the layout of the `state` column: the present state, but for the pose and the locks.
    fn write_goal(&self, physics: &Physics, into: &mut [f64]) {
        let (state, memory) = into.split_at_mut(physics.state_len());
        physics.state(state);
        state[1..=self.goal.pose.len()].copy_from_slice(&self.goal.pose);
        let [a, b] = self.goal.fixed.buttons.map(f64::from);
        let (head, previous) = memory.split_at_mut(MEMORY);
        head.copy_from_slice(&[self.goal.contact, a, b, a, b]);
        previous.copy_from_slice(&self.goal.pose);
    }

    /// Writes all columns.
    pub(super) fn write(&self, physics: &Physics, row: &mut RowMut<'_>) {
        let (data, feel) = (physics.data(), self.arm.feel(physics, self.contact));
        let (qpos, qvel) = (data.qpos(), data.qvel());
        self.observation(physics, row.at::<f64>(FIRST_TASK_COLUMN));
        self.write_goal(physics, row.at::<f64>(FIRST_TASK_COLUMN + 1));
        let mut columns = Columns { row, next: FIRST_TASK_COLUMN + 2 };
        columns.set(&qpos[..JOINTS]);
        columns.set(&qvel[..JOINTS]);
        columns.set(&feel.place);
        for number in [feel.yaw, feel.closed, feel.closing, feel.contact] {
            columns.set(&[number]);
        }
        for cube in &self.parts.cubes {
            let turn = cube.turn(qpos);
            columns.set(&cube.place(qpos));
            columns.set(&turn);
            columns.set(&[yaw(turn)]);
        }
        let (previous_qpos, previous_qvel) = self.previous.split_at(qpos.len());
        columns.set(previous_qpos);
        columns.set(previous_qvel);
        columns.set(qpos);
        columns.set(qvel);
        columns.set(data.ctrl());
        columns.set(&[data.time()]);
        columns.set(&self.goal.target);
        let places = columns.row.at::<f64>(columns.next);
        for ((place, _), into) in self.goal.cubes.iter().zip(places.chunks_exact_mut(3)) {
            into.copy_from_slice(place);
        }
        let yaws = columns.row.at::<f64>(columns.next + 1);
        for ((_, turn), into) in self.goal.cubes.iter().zip(yaws) {
            *into = yaw(*turn);
        }
        columns.next += 2;
        columns.integers(&[self.goal.subject.number()]);
        let Some(fixtures) = &self.parts.fixtures else { return };
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
        columns.set(&[self.goal.fixed.drawer]);
        columns.set(&[self.goal.fixed.window]);
        for states in [self.buttons, self.previous_buttons, self.goal.fixed.buttons] {
            columns.integers(&states.map(i64::from));
        }
        for state in self.buttons {
            columns.integers(&[i64::from(state)]);
        }
    }
}
