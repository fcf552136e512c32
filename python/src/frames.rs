//! Frames given as numpy arrays: [`VisualWrappers`] change them, and [`write_video`] stores them.

use crate::arrays;
use crate::errors::{json, to_py_err};
use crate::exit;
use numpy::{PyReadonlyArray3, PyReadonlyArray4, PyUntypedArrayMethods as _};
use pyo3::prelude::*;
use serde_json::{Map, Value};
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use swm::core::{DType, Error, FrameMut, Key};
use swm::envs::wrappers::{EpisodeFrame, VisualWrapper, WRAPPERS};

/// A stack of visual wrappers, in the order in which they are applied.
#[pyclass(frozen, module = "stable_worldmodel._engine")]
pub struct VisualWrappers(Mutex<Vec<Box<dyn VisualWrapper>>>);

#[pymethods]
impl VisualWrappers {
    /// Builds the wrappers from a JSON list of `[id, settings]`.
    #[new]
    fn new(wrappers: &str) -> PyResult<Self> {
        let choices: Vec<(String, Map<String, Value>)> = json("wrappers", wrappers)?;
        let made = choices.into_iter().map(|(id, settings)| WRAPPERS.get(&id)?.make(&settings.into_iter().collect()));
        Ok(Self(Mutex::new(made.collect::<swm::core::Result<_>>().map_err(to_py_err)?)))
    }

    /// Resets the wrappers for an episode with this seed.
    fn reset(&self, seed: u64) {
        let episode = Key::new(seed).with("wrapper");
        for (wrapper, index) in self.0.lock().unwrap_or_else(PoisonError::into_inner).iter_mut().zip(0..) {
            wrapper.reset(episode.at(index));
        }
    }

    /// Applies the wrappers to a copy of the frame at step `step` of the episode.
    ///
    /// # Shapes
    /// `frame` and the result: `[height, width, 3]`, `uint8`.
    fn apply<'py>(&self, py: Python<'py>, frame: PyReadonlyArray3<'py, u8>, step: u64) -> PyResult<Bound<'py, PyAny>> {
        let shape = frame.shape();
        let (height, width) = (shape[0], shape[1]);
        let mut rgb = frame.as_slice()?.to_vec();
        let mut wrappers = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let wrappers = &mut *wrappers;
        py.detach(|| {
            let mut frame = FrameMut::new(width, height, &mut rgb);
            wrappers.iter_mut().for_each(|wrapper| wrapper.apply(&mut frame, EpisodeFrame::Step(step)));
        });
        arrays::array(py, DType::U8, &[height, width, 3], &rgb)
    }
}

/// Returns the value of a schedule, given as JSON, at a step of the episode.
#[pyfunction]
pub fn schedule(text: &str, step: u64) -> PyResult<f64> {
    Ok(json::<swm::envs::wrappers::Schedule>("schedule", text)?.at(step))
}

/// Writes frames as an MP4 video that browsers play. An existing file is replaced only if it is such a video.
///
/// # Shapes
/// `frames`: `[count, height, width, 3]`, `uint8`.
#[pyfunction]
pub fn write_video(py: Python<'_>, path: PathBuf, frames: PyReadonlyArray4<'_, u8>, fps: u32) -> PyResult<()> {
    let shape = frames.shape();
    let (height, width) = (shape[1], shape[2]);
    if height * width == 0 || shape[3] != 3 {
        let problem = format!("they have the shape {shape:?}");
        return Err(to_py_err(Error::config("frames", problem, "give frames (count, height, width, 3)")));
    }
    let rgb = frames.as_slice()?;
    exit::detached(py, || swm::data::write_mp4(&path, width, height, fps, rgb.chunks_exact(height * width * 3)))
        .map_err(to_py_err)
}
