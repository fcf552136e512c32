//! [`CameraView`]: which camera looks at a world, and what it sees: colours, distances, or which thing is where.

use crate::{ColumnSpec, DType, EnvSpec, Error, Result, columns};
use std::fmt;

/// What a camera sees.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Modality {
    /// Colours: `[height, width, 3]` bytes.
    #[default]
    Rgb,
    /// Distances from the camera's plane: `[height, width]` of `Float32`, in metres.
    Depth,
    /// Which thing is seen: `[height, width]` of `Int32`, its number in the world's model, -1 for none.
    Segmentation,
}

impl Modality {
    const ALL: [(Self, &'static str); 3] =
        [(Self::Rgb, columns::PIXELS), (Self::Depth, columns::DEPTH), (Self::Segmentation, columns::SEGMENTATION)];

    /// What columns of it are called.
    pub fn name(self) -> &'static str {
        Self::ALL[self as usize].1
    }
}

/// A camera and what it sees; by default the colours that the world's default camera sees.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct CameraView {
    /// The camera's name, one of [`EnvSpec::cameras`]; the default one for `None`.
    pub camera: Option<String>,
    /// What it sees.
    pub modality: Modality,
}

impl CameraView {
    /// Reads `MODALITY`, `CAMERA` or `CAMERA:MODALITY`, where a modality is `pixels`, `depth` or `segmentation`.
    ///
    /// # Errors
    /// When the text behind the colon is no modality.
    pub fn parse(text: &str) -> Result<Self> {
        let modality =
            |name: &str| Modality::ALL.iter().find(|(_, known)| *known == name).map(|(modality, _)| *modality);
        if let Some(modality) = modality(text) {
            return Ok(Self { camera: None, modality });
        }
        match text.rsplit_once(':') {
            None => Ok(Self { camera: Some(text.to_owned()), modality: Modality::Rgb }),
            Some((camera, name)) => match modality(name) {
                Some(modality) => Ok(Self { camera: Some(camera.to_owned()), modality }),
                None => {
                    let known = Modality::ALL.iter().map(|(_, name)| *name);
                    Err(Error::unknown("modality of a view", name, known, "write CAMERA:MODALITY"))
                }
            },
        }
    }

    /// The column that holds it: `pixels`, `depth.CAMERA`, `segmentation`.
    pub fn column(&self, height: usize, width: usize) -> ColumnSpec {
        let name = self.to_string();
        match self.modality {
            Modality::Rgb => ColumnSpec::image(&name, height, width),
            Modality::Depth => ColumnSpec::new(name, DType::Float32, [height, width]),
            Modality::Segmentation => ColumnSpec::new(name, DType::Int32, [height, width]),
        }
    }

    /// The error of a world that does not know this view.
    pub fn unknown(&self, spec: &EnvSpec) -> Error {
        let id = &spec.id;
        match (&self.camera, spec.cameras.is_empty()) {
            (Some(camera), false) => {
                Error::unknown("camera", camera, spec.cameras.iter().map(String::as_str), format!("those of {id}"))
            }
            _ => Error::config(
                "view",
                format!("{id} knows no {self}: it has one camera and colours only"),
                "leave it out",
            ),
        }
    }
}

impl fmt::Display for CameraView {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&columns::of_camera(self.modality.name(), self.camera.as_deref()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_is_a_camera_a_modality_or_both() -> Result<()> {
        assert_eq!(CameraView::parse("pixels")?, CameraView::default());
        assert_eq!(CameraView::parse("depth")?, CameraView { camera: None, modality: Modality::Depth });
        assert_eq!(
            CameraView::parse("wrist")?,
            CameraView { camera: Some("wrist".to_owned()), modality: Modality::Rgb }
        );
        let both = CameraView::parse("top:segmentation")?;
        assert_eq!((both.to_string().as_str(), both.modality), ("segmentation.top", Modality::Segmentation));
        assert_eq!(both.column(4, 6), ColumnSpec::new("segmentation.top", DType::Int32, [4, 6]));
        let error = CameraView::parse("top:dept").expect_err("no modality").to_string();
        assert!(error.contains("depth"), "{error}");
        Ok(())
    }
}
