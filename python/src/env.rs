//! [`NativeEnv`]: a single native environment, for Gymnasium.

use crate::arrays;
use crate::data::process;
use crate::errors::to_py_err;
use crate::exit;
use crate::snapshots;
use crate::world::{factors, reset_options, stack};
use numpy::PyReadonlyArray1;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use std::sync::{Mutex, MutexGuard, PoisonError};
use swm::core::{Action, Batch, CameraView, DType, Env, Error, FrameMut, Key, Origin, Schema, limits, thread_budget};

/// A single native environment.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct NativeEnv(Mutex<State>);

struct State {
    env: Box<dyn Env>,
    /// The info columns of the current step, one row.
    row: Batch,
}

impl NativeEnv {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Observes the environment and copies its info columns into arrays.
    fn observe<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        self.env.observe(&mut self.row.row_mut(0));
        let dict = PyDict::new(py);
        for (i, column) in self.row.schema().columns().iter().enumerate() {
            dict.set_item(&column.name, arrays::array(py, column.dtype, &column.shape, self.row.bytes(i))?)?;
        }
        Ok(dict)
    }
}

#[pymethods]
impl NativeEnv {
    #[new]
    fn new(py: Python<'_>, id: &str, wrappers: &str, wrap_goal: bool) -> PyResult<Self> {
        let (stack, goal) = stack(wrappers, wrap_goal)?;
        let made = exit::detached(py, || {
            let env = stack.wrap(swm::env(id, &Origin::User)?.env()?, goal);
            let row = Batch::zeros(&Schema::new(env.spec().columns.clone())?, 1);
            Ok(State { env, row })
        });
        made.map(|state| Self(Mutex::new(state))).map_err(to_py_err)
    }

    /// The specification as JSON.
    fn spec(&self) -> String {
        swm::describe::spec(self.lock().env.spec()).to_string()
    }

    /// Starts an episode and returns the info columns.
    fn reset<'py>(&self, py: Python<'py>, seed: u64, options: &str) -> PyResult<Bound<'py, PyDict>> {
        let options = reset_options(options)?;
        let mut state = self.lock();
        let state = &mut *state;
        exit::detached(py, || state.env.reset(seed, &options)).map_err(to_py_err)?;
        state.observe(py)
    }

    /// Applies an action, a `float32` or `int64` array `[dim]`. Returns the info columns, the reward, and the flags
    /// terminated, truncated and success.
    #[allow(clippy::type_complexity, reason = "a Python tuple")]
    fn step<'py>(
        &self,
        py: Python<'py>,
        action: &Bound<'py, PyAny>,
    ) -> PyResult<(Bound<'py, PyDict>, f64, bool, bool, bool)> {
        let mut state = self.lock();
        let state = &mut *state;
        let stepped = if let Ok(values) = action.extract::<PyReadonlyArray1<'_, f32>>() {
            let values = values.as_slice()?;
            exit::detached(py, || state.env.step(Action::Continuous(values)))
        } else if let Ok(integers) = action.extract::<PyReadonlyArray1<'_, i64>>() {
            let integers = integers.as_slice()?;
            exit::detached(py, || state.env.step(Action::Discrete(integers)))
        } else {
            return Err(PyTypeError::new_err(format!(
                "step: expected a float32 or int64 array as action, got {action:?}"
            )));
        };
        let transition = stepped.map_err(to_py_err)?;
        let success = state.env.is_success();
        Ok((state.observe(py)?, transition.reward, transition.terminated, transition.truncated, success))
    }

    /// Renders the environment, or its goal if `goal` is set, into an array `[height, width, 3]` of `uint8`.
    fn render<'py>(&self, py: Python<'py>, height: usize, width: usize, goal: bool) -> PyResult<Bound<'py, PyAny>> {
        let mut state = self.lock();
        let state = &mut *state;
        limits::IMAGE_SIDE.check(height.max(width)).map_err(to_py_err)?;
        let mut rgb = vec![0; height * width * 3];
        let frame = FrameMut::new(width, height, &mut rgb);
        let draw = || if goal { state.env.render_goal(frame) } else { state.env.render(frame) };
        process::detached(py, || thread_budget::all(draw)).map_err(to_py_err)?;
        arrays::array(py, DType::U8, &[height, width, 3], &rgb)
    }

    /// Renders a camera view, such as `wrist:depth`.
    fn render_view<'py>(
        &self,
        py: Python<'py>,
        view: &str,
        height: usize,
        width: usize,
    ) -> PyResult<Bound<'py, PyAny>> {
        let view = CameraView::parse(view).map_err(to_py_err)?;
        limits::IMAGE_SIDE.check(height.max(width)).map_err(to_py_err)?;
        let column = view.column(height, width);
        let mut bytes = vec![0; column.row_bytes()];
        let mut state = self.lock();
        let state = &mut *state;
        process::detached(py, || thread_budget::all(|| state.env.render_view(&view, height, width, &mut bytes)))
            .map_err(to_py_err)?;
        arrays::array(py, column.dtype, &column.shape, &bytes)
    }

    /// The factors of the current episode, by key.
    fn factors<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        factors(py, &*self.lock().env)
    }

    /// The distance of the state from the goal, in the environment's units.
    fn goal_distance(&self) -> f64 {
        self.lock().env.goal_distance()
    }

    fn success_distance(&self) -> f64 {
        self.lock().env.success_distance()
    }

    /// Whether the state satisfies the goal.
    fn is_success(&self) -> bool {
        self.lock().env.is_success()
    }

    /// Samples a new reachable goal.
    fn sample_goal(&self, seed: u64) -> PyResult<()> {
        self.lock().env.sample_goal(Key::new(seed).with("goal")).map_err(to_py_err)
    }

    /// Returns the full state, including the environment's random state.
    fn snapshot<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        PyBytes::new(py, &snapshots::seal(self.lock().env.snapshot()))
    }

    /// Restores a snapshot and returns the info columns.
    fn restore<'py>(&self, py: Python<'py>, state: Vec<u8>) -> PyResult<Bound<'py, PyDict>> {
        let mut this = self.lock();
        this.env.restore(&snapshots::unseal(state)?).map_err(to_py_err)?;
        this.observe(py)
    }

    /// Restores the state of a dataset row, with the state of another row as the goal. Returns the info columns.
    fn restore_from<'py>(
        &self,
        py: Python<'py>,
        start: &Bound<'py, PyDict>,
        goal: &Bound<'py, PyDict>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let (start, goal) = (arrays::batch(start)?, arrays::batch(goal)?);
        if start.rows() != 1 || goal.rows() != 1 {
            let given = format!("{} rows of a start, {} of a goal", start.rows(), goal.rows());
            return Err(to_py_err(Error::mismatch("restoring from a dataset", given, "one row of each")));
        }
        let mut this = self.lock();
        this.env.restore_from(start.row(0), goal.row(0)).map_err(to_py_err)?;
        this.observe(py)
    }
}
