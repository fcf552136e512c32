//! [`CameraView`]: a camera of an environment and the modality it renders: colour, depth or segmentation.

use crate::{ColumnSpec, DType, EnvSpec, Error, Result, columns};
use std::fmt;

/// The kind of image a camera renders.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Modality {
    /// Colour: `[height, width, 3]` bytes.
    #[default]
    Rgb,
    /// Distance from the camera plane: `[height, width]` of `Float32`, in metres.
    Depth,
    /// The index of the visible geometry in the simulator's model: `[height, width]` of `Int32`, -1 for the
    /// background.
    Segmentation,
}

impl Modality {
    const ALL: [(Self, &'static str); 3] =
        [(Self::Rgb, columns::PIXELS), (Self::Depth, columns::DEPTH), (Self::Segmentation, columns::SEGMENTATION)];

    /// The name of the modality in column names: `pixels`, `depth` or `segmentation`.
    pub fn name(self) -> &'static str {
        Self::ALL[self as usize].1
    }
}

/// A camera and its modality; by default, colour from the default camera.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct CameraView {
    /// The camera's name, one of [`EnvSpec::cameras`]; `None` for the default camera.
    pub camera: Option<String>,
    /// The kind of image.
    pub modality: Modality,
}

impl CameraView {
    /// Parses `MODALITY`, `CAMERA` or `CAMERA:MODALITY`, where a modality is `pixels`, `depth` or `segmentation`.
    ///
    /// # Errors
    /// When the text after the colon is not a modality, or the camera's name cannot be a part of the name of a column and its files.
    pub fn parse(text: &str) -> Result<Self> {
        let modality =
            |name: &str| Modality::ALL.iter().find(|(_, known)| *known == name).map(|(modality, _)| *modality);
        if let Some(modality) = modality(text) {
            return Ok(Self { camera: None, modality });
        }
        match text.rsplit_once(':') {
            None => Ok(Self { camera: Some(checked(text)?), modality: Modality::Rgb }),
            Some((camera, name)) => match modality(name) {
                Some(modality) => Ok(Self { camera: Some(checked(camera)?), modality }),
                None => {
                    let known = Modality::ALL.map(|(_, name)| name);
                    let hint =
                        format!("write a camera view as CAMERA:MODALITY; the modalities are {}", known.join(", "));
                    Err(Error::unknown("camera modality", name, known, hint))
                }
            },
        }
    }

    /// Returns the column that stores the view, named `pixels`, `depth.CAMERA`, `segmentation`, …
    pub fn column(&self, height: usize, width: usize) -> ColumnSpec {
        let name = self.to_string();
        match self.modality {
            Modality::Rgb => ColumnSpec::image(&name, height, width),
            Modality::Depth => ColumnSpec::new(name, DType::Float32, [height, width]),
            Modality::Segmentation => ColumnSpec::new(name, DType::Int32, [height, width]),
        }
    }

    /// Returns the error for an environment that cannot render this view.
    pub fn unknown(&self, spec: &EnvSpec) -> Error {
        let id = &spec.id;
        match (&self.camera, spec.cameras.is_empty()) {
            (Some(camera), false) => {
                let known = spec.cameras.iter().map(String::as_str);
                Error::unknown("camera", camera, known, format!("the cameras of {id} are {}", spec.cameras.join(", ")))
            }
            _ => Error::config(
                "camera view",
                format!("{id} cannot render {self}: it has one camera and renders colour only"),
                "omit the view",
            ),
        }
    }
}

/// Returns the name of a camera. The column of its view is a file in some formats.
///
/// # Errors
/// When the name is empty, or has characters that no such file has.
fn checked(camera: &str) -> Result<String> {
    let problem = match camera {
        "" => "the name of the camera is empty",
        _ if camera.contains(['/', '\\']) => "the name of a camera has no slashes",
        _ if camera.starts_with('.') => "the name of a camera does not begin with a dot",
        _ if camera.chars().any(char::is_control) => "the name of a camera has no control characters",
        _ => return Ok(camera.to_owned()),
    };
    let fix = "write CAMERA, MODALITY or CAMERA:MODALITY; `swm envs ENV` lists the cameras of an environment";
    Err(Error::config(format!("the camera view '{camera}'"), problem, fix))
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
    fn parses_views_of_a_camera_a_modality_or_both() -> Result<()> {
        assert_eq!(CameraView::parse("pixels")?, CameraView::default());
        assert_eq!(CameraView::parse("depth")?, CameraView { camera: None, modality: Modality::Depth });
        let wrist = CameraView { camera: Some("wrist".to_owned()), modality: Modality::Rgb };
        assert_eq!(CameraView::parse("wrist")?, wrist);
        let both = CameraView::parse("top:segmentation")?;
        assert_eq!((both.to_string().as_str(), both.modality), ("segmentation.top", Modality::Segmentation));
        assert_eq!(both.column(4, 6), ColumnSpec::new("segmentation.top", DType::Int32, [4, 6]));
        let error = CameraView::parse("top:dept").expect_err("an unknown modality").to_string();
        assert!(error.contains("depth"), "{error}");
        for wrong in ["", ":depth", "../../x", "a/b:depth", "a\\b", ".x", "a\nb"] {
            let error = CameraView::parse(wrong).expect_err(wrong).to_string();
            assert!(error.contains("name of") && error.contains("CAMERA:MODALITY"), "{error}");
        }
        Ok(())
    }
}
