//! [`Pictures`]: visual wrappers on pictures of Python's.

use crate::arrays;
use crate::errors::{json, raised};
use numpy::{PyReadonlyArray3, PyUntypedArrayMethods as _};
use pyo3::prelude::*;
use serde_json::{Map, Value};
use std::sync::{Mutex, PoisonError};
use swm::core::{DType, FrameMut, Key};
use swm::envs::wrappers::{EpisodeFrame, VisualWrapper, WRAPPERS};

/// Wrappers in the order in which they are applied.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct Pictures(Mutex<Vec<Box<dyn VisualWrapper>>>);

#[pymethods]
impl Pictures {
    #[new]
    fn new(wrappers: &str) -> PyResult<Self> {
        let choices: Vec<(String, Map<String, Value>)> = json("wrappers", wrappers)?;
        let made = choices.into_iter().map(|(id, settings)| WRAPPERS.get(&id)?.make(&settings.into_iter().collect()));
        Ok(Self(Mutex::new(made.collect::<swm::core::Result<_>>().map_err(raised)?)))
    }

    /// Begins the episode of a seed.
    fn begin(&self, seed: u64) {
        let episode = Key::new(seed).with("wrapper");
        for (wrapper, place) in self.0.lock().unwrap_or_else(PoisonError::into_inner).iter_mut().zip(0..) {
            wrapper.reset(episode.at(place));
        }
    }

    /// A changed copy of a picture that shows the world after some steps.
    fn apply<'py>(
        &self,
        py: Python<'py>,
        picture: PyReadonlyArray3<'py, u8>,
        step: u64,
    ) -> PyResult<Bound<'py, PyAny>> {
        let shape = picture.shape();
        let (height, width) = (shape[0], shape[1]);
        let mut rgb = picture.as_slice()?.to_vec();
        let mut wrappers = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let wrappers = &mut *wrappers;
        py.detach(|| {
            let mut frame = FrameMut::new(width, height, &mut rgb);
            wrappers.iter_mut().for_each(|wrapper| wrapper.apply(&mut frame, EpisodeFrame::Step(step)));
        });
        arrays::array(py, DType::U8, &[height, width, 3], &rgb)
    }
}

/// The number of a schedule at a step.
#[pyfunction]
pub fn schedule(text: &str, step: u64) -> PyResult<f64> {
    Ok(json::<swm::envs::wrappers::Schedule>("schedule", text)?.at(step))
}
