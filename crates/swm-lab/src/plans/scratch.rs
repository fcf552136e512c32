//! [`Scratch`]: a private environment that renders snapshots, and plays candidates from them.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use swm_core::{Action, Batch, Env, EnvChoice, FrameMut, Result, Schema, Snapshot, Space, columns};
use swm_data::ImageCodec;
use swm_plan::ActionScale;

/// The quality of frames.
const QUALITY: u8 = 92;
/// Elements of a state that a path has.
const MOST_STATE: usize = 64;

/// Encodes a square frame as JPEG in Base64.
///
/// # Errors
/// When the frame is too large.
pub fn jpeg(rgb: &[u8], side: usize) -> Result<String> {
    let mut bytes = vec![];
    ImageCodec::Jpeg { quality: QUALITY }.encode(rgb, side, side, &mut bytes)?;
    Ok(STANDARD.encode(bytes))
}

/// A private environment, in any state.
pub struct Scratch {
    env: Box<dyn Env>,
    row: Batch,
}

impl Scratch {
    /// Makes the environment.
    ///
    /// # Errors
    /// When it lacks assets.
    pub fn new(choice: &EnvChoice) -> Result<Self> {
        let env = choice.env()?;
        let row = Batch::zeros(&Schema::new(env.spec().columns.clone())?, 1);
        Ok(Self { env, row })
    }

    /// Renders a snapshot, or its goal, as JPEG at the end of `bytes`.
    ///
    /// # Errors
    /// When the renderer fails.
    pub fn render(&mut self, snapshot: &Snapshot, goal: bool, side: usize, bytes: &mut Vec<u8>) -> Result<()> {
        self.env.restore(snapshot)?;
        self.render_present(goal, side, bytes)
    }

    fn render_present(&mut self, goal: bool, side: usize, bytes: &mut Vec<u8>) -> Result<()> {
        let mut rgb = vec![0; side * side * 3];
        let frame = FrameMut::new(side, side, &mut rgb);
        if goal {
            self.env.render_goal(frame)?
        } else {
            self.env.render(frame)?
        }
        ImageCodec::Jpeg { quality: QUALITY }.encode(&rgb, side, side, bytes)
    }

    /// Renders a snapshot, or its goal, into RGB bytes.
    ///
    /// # Errors
    /// As [`Scratch::render`].
    pub fn pixels(&mut self, snapshot: &Snapshot, goal: bool, side: usize, rgb: &mut [u8]) -> Result<()> {
        self.env.restore(snapshot)?;
        let frame = FrameMut::new(side, side, rgb);
        if goal { self.env.render_goal(frame) } else { self.env.render(frame) }
    }

    /// Renders the present state into RGB bytes.
    ///
    /// # Errors
    /// As [`Scratch::render`].
    pub fn pixels_now(&mut self, side: usize, rgb: &mut [u8]) -> Result<()> {
        self.env.render(FrameMut::new(side, side, rgb))
    }

    /// Takes the steps of some plan values from the present state.
    ///
    /// # Errors
    /// When the environment fails.
    pub fn go_on(&mut self, codec: &Codec, actions: &[f32]) -> Result<()> {
        let mut decoded = Decoded::default();
        for planned in actions.chunks_exact(codec.width()) {
            self.env.step(codec.decode(planned, &mut decoded))?;
        }
        Ok(())
    }

    /// Renders a snapshot, or its goal, as JPEG in Base64.
    ///
    /// # Errors
    /// As [`Scratch::render`].
    pub fn image(&mut self, snapshot: &Snapshot, goal: bool, side: usize) -> Result<String> {
        let mut bytes = vec![];
        self.render(snapshot, goal, side, &mut bytes)?;
        Ok(STANDARD.encode(bytes))
    }

    /// Plays a candidate from a snapshot; returns the state at the start and after every step.
    ///
    /// # Errors
    /// When the environment fails.
    pub fn play(&mut self, from: &Snapshot, codec: &Codec, actions: &[f32]) -> Result<Vec<Vec<f64>>> {
        self.env.restore(from)?;
        let mut states = vec![self.state()?];
        let mut decoded = Decoded::default();
        for planned in actions.chunks_exact(codec.width()) {
            self.env.step(codec.decode(planned, &mut decoded))?;
            states.push(self.state()?);
        }
        Ok(states)
    }

    /// Renders where the last candidate ended, as JPEG in Base64.
    ///
    /// # Errors
    /// As [`Scratch::render`].
    pub fn end(&mut self, side: usize) -> Result<String> {
        let mut bytes = vec![];
        self.render_present(false, side, &mut bytes)?;
        Ok(STANDARD.encode(bytes))
    }

    fn state(&mut self) -> Result<Vec<f64>> {
        self.env.observe(&mut self.row.row_mut(0));
        let mut state = self.row.row(0).to_f64(columns::STATE)?;
        state.truncate(MOST_STATE);
        Ok(state)
    }
}

/// Converts the values of a plan to the actions that an environment executes, as the planner does.
pub struct Codec {
    space: Space,
    scale: ActionScale,
}

/// The memory of an action.
#[derive(Default)]
pub struct Decoded {
    values: Vec<f32>,
    integers: Vec<i64>,
}

impl Codec {
    /// The codec of an action space.
    pub fn new(space: &Space, scale: ActionScale) -> Self {
        Self { space: space.clone(), scale }
    }

    /// The options of each integer of an action, and the first of them.
    fn options(&self) -> Vec<(usize, i64)> {
        let bounds = (0..self.space.len()).map(|i| self.space.bounds(i));
        bounds.map(|(low, high)| ((high - low) as usize + 1, low as i64)).collect()
    }

    /// Returns the actions of a box in the environment's units, clipped to it.
    pub fn scaled(&self, planned: &[f32]) -> Vec<f32> {
        let (mut decoded, mut all) = (Decoded::default(), vec![]);
        for planned in planned.chunks_exact(self.width()) {
            if let Action::Continuous(values) = self.decode(planned, &mut decoded) {
                all.extend_from_slice(values);
            }
        }
        all
    }

    /// Plan values of an action.
    pub fn width(&self) -> usize {
        match self.space {
            Space::Box { .. } => self.space.len(),
            _ => self.options().iter().map(|(count, _)| count).sum(),
        }
    }

    fn decode<'a>(&self, planned: &[f32], decoded: &'a mut Decoded) -> Action<'a> {
        if let Space::Box { .. } = self.space {
            decoded.values.resize(planned.len(), 0.0);
            self.scale.to_env(planned, &mut decoded.values);
            for (i, value) in decoded.values.iter_mut().enumerate() {
                let (low, high) = self.space.bounds(i);
                *value = value.clamp(low as f32, high as f32);
            }
            return Action::Continuous(&decoded.values);
        }
        decoded.integers.clear();
        let mut rest = planned;
        for (count, first) in self.options() {
            let (weights, tail) = rest.split_at(count);
            // Of several largest weights, the first.
            let best = (0..count).reduce(|best, i| if weights[i] > weights[best] { i } else { best });
            decoded.integers.push(first + best.unwrap_or(0) as i64);
            rest = tail;
        }
        Action::Discrete(&decoded.integers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn candidates_lead_where_their_actions_lead() {
        let choice = swm_envs::ENVS.choose("swm/TwoRoom-v1").expect("an environment");
        let mut env = choice.env().expect("an environment");
        env.reset(3, &swm_core::ResetOptions::default()).expect("a reset");
        let start = env.snapshot();
        let codec =
            Codec::new(&env.spec().action_space.clone(), ActionScale { mean: vec![0.1, 0.0], std: vec![0.5, 1.0] });
        let mut scratch = Scratch::new(&choice).expect("an environment");
        // In model units; the second step is beyond the box.
        let states = scratch.play(&start, &codec, &[1.0, -0.5, 9.0, 0.0]).expect("a path");
        let mut expected = vec![];
        for action in [[0.6, -0.5], [1.0, 0.0]] {
            env.step(Action::Continuous(&action)).expect("a step");
            let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("columns"), 1);
            env.observe(&mut row.row_mut(0));
            expected.push(row.row(0).to_f64("state").expect("a state"));
        }
        assert_eq!(states[1..], expected);
        let mut jpeg = vec![];
        scratch.render(&start, false, 32, &mut jpeg).expect("a frame");
        assert_eq!(swm_data::image::image_size(&jpeg).expect("a JPEG"), (32, 32));
    }

    #[test]
    fn integers_are_the_first_of_the_largest_weights() {
        let space = Space::MultiDiscrete { nvec: vec![3, 2], start: vec![0, 5] };
        let codec = Codec::new(&space, ActionScale { mean: vec![], std: vec![] });
        let mut decoded = Decoded::default();
        let Action::Discrete(integers) = codec.decode(&[0.1, 0.5, 0.5, 0.0, 1.0], &mut decoded) else {
            panic!("integers")
        };
        assert_eq!((codec.width(), integers), (5, &[1, 6][..]));
    }
}
