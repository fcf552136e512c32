//! [`Rendering`]: what a page shows of an environment: a camera view, and the wrappers that change its frames.

use serde_json::Value;
use swm_core::{Batch, CameraView, ColumnSpec, Env, EnvChoice, Error, FrameMut, Result, Schema, columns};
use swm_data::preview::in_colour;

/// What the program knows of wrappers.
pub trait Wrapping: Send + Sync {
    /// The wrappers that a page may choose, each with `id`, `summary` and `parameters`.
    fn listed(&self) -> Value;

    /// Wraps an environment in wrappers in the form of the command line, such as `noise,std=8`, first to last.
    ///
    /// # Errors
    /// When a wrapper is unknown or reads files, or a setting is not allowed.
    fn wrap(&self, env: Box<dyn Env>, wrappers: &[String], wrap_goal: bool) -> Result<Box<dyn Env>>;

    /// The wrappers as the manifest of a dataset has them.
    ///
    /// # Errors
    /// As [`Wrapping::wrap`].
    fn manifest(&self, wrappers: &[String]) -> Result<Value>;
}

/// A camera view of an environment, and wrappers of its frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rendering {
    /// The camera view.
    pub view: CameraView,
    /// Wrappers in the form of the command line, in the order in which they are applied.
    pub wrappers: Vec<String>,
    /// Whether they change the frame of the goal, too.
    pub wrap_goal: bool,
}

impl Rendering {
    /// Parses a rendering as [`crate::still::StillQuery`] has it.
    ///
    /// # Errors
    /// When the modality of the view is unknown, or wrappers are chosen for another view than the colour of the default camera.
    pub fn parse(view: Option<&str>, wrappers: &str, wrap_goal: bool) -> Result<Self> {
        let view = view.map_or_else(|| Ok(CameraView::default()), CameraView::parse)?;
        let wrappers: Vec<String> = wrappers.split(';').filter(|one| !one.is_empty()).map(str::to_owned).collect();
        if !wrappers.is_empty() && view != CameraView::default() {
            let problem = format!("wrappers do not change the view {view}");
            return Err(Error::config("wrappers", problem, "remove them, or choose the colour of the default camera"));
        }
        let wrap_goal = wrap_goal && !wrappers.is_empty();
        Ok(Self { view, wrappers, wrap_goal })
    }

    /// Makes the environment with its wrappers.
    ///
    /// # Errors
    /// As [`Wrapping::wrap`], or when the environment lacks assets.
    pub fn env(&self, choice: &EnvChoice, wrapping: &dyn Wrapping) -> Result<Box<dyn Env>> {
        let env = choice.env()?;
        if self.wrappers.is_empty() { Ok(env) } else { wrapping.wrap(env, &self.wrappers, self.wrap_goal) }
    }

    /// The views that are rendered beside the colour of the default camera.
    pub fn views(&self) -> Vec<CameraView> {
        if self.is_default_view() { vec![] } else { vec![self.view.clone()] }
    }

    /// Whether it shows the colour of the default camera.
    pub fn is_default_view(&self) -> bool {
        self.view == CameraView::default()
    }

    /// The column with the frame that is shown.
    pub fn column(&self) -> String {
        if self.is_default_view() { columns::PIXELS.to_owned() } else { self.view.to_string() }
    }

    /// Renders the present state, or the goal; depth and segmentation in the colours of `swm preview`.
    ///
    /// # Shapes
    /// The result is `[height, width, 3]` bytes.
    ///
    /// # Errors
    /// When the environment has no such view, the goal of another view is asked for, or the renderer fails.
    pub fn render(&self, env: &mut dyn Env, goal: bool, (height, width): (usize, usize)) -> Result<Vec<u8>> {
        if !self.is_default_view() {
            if goal {
                let fix = "choose the colour of the default camera";
                return Err(Error::config("the frame of the goal", format!("it has no view {}", self.view), fix));
            }
            let column = self.view.column(height, width);
            let mut row = Batch::zeros(&Schema::new([column.clone()])?, 1);
            env.render_view(&self.view, height, width, row.row_mut(0).bytes(0))?;
            return Ok(colours(&column, row.bytes(0)).into_owned());
        }
        let mut rgb = vec![0; height * width * 3];
        let frame = FrameMut::new(width, height, &mut rgb);
        if goal {
            env.render_goal(frame)?
        } else {
            env.render(frame)?
        }
        Ok(rgb)
    }

    /// The options of `swm frame` for this rendering.
    pub fn options(&self) -> String {
        let mut options = String::new();
        if !self.is_default_view() {
            let modality = self.view.modality.name();
            options += " --view ";
            options += &match &self.view.camera {
                None => modality.to_owned(),
                Some(camera) if modality == columns::PIXELS => camera.clone(),
                Some(camera) => format!("{camera}:{modality}"),
            };
        }
        for wrapper in &self.wrappers {
            options += &format!(" --wrapper {wrapper}");
        }
        options + if self.wrap_goal { " --wrap-goal" } else { "" }
    }
}

/// The RGB bytes of a row of a view.
pub fn colours<'a>(column: &ColumnSpec, bytes: &'a [u8]) -> std::borrow::Cow<'a, [u8]> {
    if column.is_image() { bytes.into() } else { in_colour(column, bytes).concat().into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn renderings_are_parsed_and_are_options_of_the_command() {
        let options =
            |view: Option<&str>, wrappers: &str, goal| Rendering::parse(view, wrappers, goal).map(|r| r.options());
        assert_eq!(options(None, "", true).expect("it"), "");
        assert_eq!(options(Some("pixels"), ";", false).expect("it"), "");
        assert_eq!(options(Some("depth"), "", false).expect("it"), " --view depth");
        assert_eq!(options(Some("top"), "", false).expect("it"), " --view top");
        assert_eq!(options(Some("top:segmentation"), "", false).expect("it"), " --view top:segmentation");
        let stacked = options(None, "noise,std=8;blur", true).expect("it");
        assert_eq!(stacked, " --wrapper noise,std=8 --wrapper blur --wrap-goal");
        assert!(options(Some("depth"), "blur", false).is_err() && options(Some("top:dept"), "", false).is_err());
    }
}
