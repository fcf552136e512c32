//! One frame of an environment at the start of an episode, as PNG: what `swm frame` writes and the lab shows.

use crate::rendering::Rendering;
use serde::Deserialize;
use std::collections::BTreeMap;
use swm_core::{Env, EnvSpec, Error, ResetOptions, Result, VariationRequest, limits};

/// The side of a frame in pixels, unless a request says otherwise.
pub const SIDE: usize = 224;

/// The start of an episode, and the size of its frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Still {
    /// The seed of the reset, which a dataset has in the elements of `episode_seed` (docs/data.md).
    pub seed: u64,
    /// Factors to sample and to pin.
    pub variation: VariationRequest,
    /// Whether to show the goal instead of the state.
    pub goal: bool,
    /// Height and width in pixels.
    pub size: (usize, usize),
    /// The camera view and the wrappers.
    pub rendering: Rendering,
}

/// A still as the query of a URL: `seed=1&image=224&pin=agent.color=1,2,3;agent.speed=2&variation=all`.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StillQuery {
    /// The environment.
    pub env: String,
    /// The seed.
    #[serde(default)]
    pub seed: u64,
    /// The side of the frame.
    pub image: Option<usize>,
    /// Pinned factors, `KEY=NUMBER[,NUMBER…]`, separated by `;`.
    #[serde(default)]
    pub pin: String,
    /// Factors to sample, separated by `,`; `none` for none. Left out for the environment's defaults.
    pub variation: Option<String>,
    /// Whether to show the goal.
    #[serde(default)]
    pub goal: bool,
    /// The camera view: `CAMERA`, `depth`, `segmentation` or `CAMERA:depth`.
    pub view: Option<String>,
    /// Wrappers, `NAME[,KEY=VALUE…]`, separated by `;`.
    #[serde(default)]
    pub wrappers: String,
    /// Whether wrappers change the goal, too.
    #[serde(default)]
    pub wrap_goal: bool,
}

impl StillQuery {
    /// Returns the still.
    ///
    /// # Errors
    /// When a pin is malformed, or as [`Rendering::parse`].
    pub fn still(&self) -> Result<Still> {
        let side = self.image.unwrap_or(SIDE);
        Ok(Still {
            seed: self.seed,
            variation: request(&self.pin, self.variation.as_deref())?,
            goal: self.goal,
            size: (side, side),
            rendering: Rendering::parse(self.view.as_deref(), &self.wrappers, self.wrap_goal)?,
        })
    }
}

/// Parses pinned and sampled factors as [`StillQuery`] has them.
///
/// # Errors
/// When a pin is malformed.
pub fn request(pins: &str, variation: Option<&str>) -> Result<VariationRequest> {
    let mut variation_values = BTreeMap::new();
    for pin in pins.split(';').filter(|pin| !pin.is_empty()) {
        let wrong =
            || Error::config(format!("pin {pin}"), "it is not KEY=NUMBER[,NUMBER…]", "write it like agent.color=1,2,3");
        let (key, values) = pin.split_once('=').ok_or_else(wrong)?;
        let values: Option<Vec<f64>> = values.split(',').map(|value| value.trim().parse().ok()).collect();
        variation_values.insert(key.to_owned(), values.ok_or_else(wrong)?);
    }
    let variation = variation.map(|keys| match keys {
        "none" | "" => vec![],
        keys => keys.split(',').map(str::to_owned).collect(),
    });
    Ok(VariationRequest { variation, variation_values })
}

/// The options of a command for sampled and pinned factors, which were checked, each after a space.
///
/// # Errors
/// When a factor is unknown.
pub fn factor_options(spec: &EnvSpec, request: &VariationRequest) -> Result<String> {
    let mut options = String::new();
    match request.variation.as_deref() {
        None => {}
        Some([]) => options += " --variation none",
        Some(keys) => options += &format!(" --variation {}", keys.join(",")),
    }
    for (i, (key, values)) in request.variation_values.iter().enumerate() {
        let space = &spec.variation_space.factors()[spec.variation_space.select(key)?[0]].space;
        let values = space.format_values(values).replace(' ', "");
        options += &format!("{} {key}={values}", if i == 0 { " --pin" } else { "" });
    }
    Ok(options)
}

impl Still {
    /// Renders the frame of an environment that [`Rendering::env`] made.
    ///
    /// # Shapes
    /// The result is `[height, width, 3]` bytes.
    ///
    /// # Errors
    /// When a factor is unknown or out of bounds, the size is too large, or the renderer fails.
    pub fn render(&self, env: &mut dyn Env) -> Result<Vec<u8>> {
        let (height, width) = self.checked_size()?;
        let options = ResetOptions { variation: self.variation.clone(), ..ResetOptions::default() };
        env.reset(self.seed, &options)?;
        self.rendering.render(env, self.goal, (height, width))
    }

    /// Renders the frame as PNG. Equal stills give equal bytes.
    ///
    /// # Errors
    /// As [`Still::render`].
    pub fn png(&self, env: &mut dyn Env) -> Result<Vec<u8>> {
        let rgb = self.render(env)?;
        let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
        let mut bytes = vec![];
        let mut encoder = png::Encoder::new(&mut bytes, side(self.size.1), side(self.size.0));
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        // By which `swm_data::check_png` knows a file of this program.
        let written = encoder
            .add_text_chunk("Software".to_owned(), "stable-worldmodel".to_owned())
            .and_then(|()| encoder.write_header())
            .and_then(|mut writer| writer.write_image_data(&rgb).and_then(|()| writer.finish()));
        written.map_err(|error| Error::external("encoding a frame", error))?;
        Ok(bytes)
    }

    /// Returns height and width.
    fn checked_size(&self) -> Result<(usize, usize)> {
        let (height, width) = self.size;
        limits::IMAGE_SIDE.check(height.max(width))?;
        if height.min(width) == 0 {
            return Err(Error::config("frame size", format!("{height} x {width}"), "choose at least one pixel"));
        }
        Ok((height, width))
    }

    /// The command line that writes this frame.
    ///
    /// # Errors
    /// When a factor or a camera is unknown, or a value or the size is out of bounds: the command would fail.
    pub fn command(&self, spec: &EnvSpec) -> Result<String> {
        spec.variation_space.check(&self.variation)?;
        let view = &self.rendering.view;
        // What is copied into a shell has the names of the environment only.
        if view.camera.as_ref().is_some_and(|camera| !spec.cameras.contains(camera)) {
            return Err(view.unknown(spec));
        }
        let (height, width) = self.checked_size()?;
        let mut command = format!("swm frame {} --seed {}", spec.id, self.seed);
        if self.size != (SIDE, SIDE) {
            command +=
                &if height == width { format!(" --image {height}") } else { format!(" --image {height}x{width}") };
        }
        if self.goal {
            command += " --goal";
        }
        command += &self.rendering.options();
        command += &factor_options(spec, &self.variation)?;
        Ok(command + " --output frame.png")
    }

    /// The Python program whose `frame` has the pixels of this frame; `None` for a frame of another view or with wrappers.
    ///
    /// # Errors
    /// As [`Still::command`].
    pub fn python(&self, spec: &EnvSpec) -> Result<Option<String>> {
        if self.rendering != Rendering::default() {
            return Ok(None);
        }
        spec.variation_space.check(&self.variation)?;
        let (height, width) = self.checked_size()?;
        let mut parts = spec.id.split(',');
        let id = parts.next().unwrap_or_default();
        let options: String =
            parts.filter_map(|part| part.split_once('=')).map(|(key, value)| format!(", {key}=\"{value}\"")).collect();
        let size = if self.size == (SIDE, SIDE) { String::new() } else { format!(", image_shape=({height}, {width})") };
        let mut reset = vec![];
        if let Some(keys) = &self.variation.variation {
            reset.push(format!("\"variation\": {keys:?}"));
        }
        let pins = self.variation.variation_values.iter().map(|(key, values)| {
            let space = &spec.variation_space.factors()[spec.variation_space.select(key)?[0]].space;
            Ok(format!("\"{key}\": [{}]", space.format_values(values)))
        });
        let pins = pins.collect::<Result<Vec<_>>>()?;
        if !pins.is_empty() {
            reset.push(format!("\"variation_values\": {{{}}}", pins.join(", ")));
        }
        let reset = if reset.is_empty() { String::new() } else { format!(", options={{{}}}", reset.join(", ")) };
        let render = if self.goal { "env.unwrapped.render_goal()" } else { "env.render()" };
        let head = "import gymnasium\nimport stable_worldmodel\n\n";
        Ok(Some(format!(
            "{head}env = gymnasium.make(\"{id}\"{options}{size})\nenv.reset(seed={}{reset})\nframe = {render}\n",
            self.seed
        )))
    }
}
