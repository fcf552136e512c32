//! An environment whose outcomes can be computed by hand: a point on a line that has to reach a goal.

use rand::Rng as _;
use swm_core::policy::write_action;
use swm_core::{
    Action, Batch, ColumnSpec, DType, Env, EnvEntry, EnvSpec, Error, Factor, FactorValues, FrameMut, Key, Policy,
    ResetOptions, Result, Rng, RowMut, RowRef, Snapshot, Space, Transition, VariationSpace,
};

pub const ENTRY: EnvEntry = EnvEntry {
    id: "test/Line-v0",
    summary: "Reach a point on a line.",
    options: &[],
    make: |_| Ok(Box::new(Line::new())),
    experts: &[],
};

/// The largest distance at which the goal counts as reached.
pub const NEAR: f64 = 0.25;

pub struct Line {
    pub spec: EnvSpec,
    factors: FactorValues,
    x: f64,
    goal: f64,
    /// A random value drawn at every step, to test that random values depend only on the episode.
    noise: f64,
    rng: Rng,
}

impl Line {
    pub fn new() -> Self {
        let variation_space = VariationSpace::new(
            vec![
                Factor::new("agent.x", Space::uniform_box([], DType::Float32, -4.0, 4.0), [0.0]),
                Factor::new("agent.color", Space::Rgb, [255.0, 0.0, 0.0]),
                Factor::new("goal.x", Space::uniform_box([], DType::Float64, -4.0, 4.0), [2.0]),
            ],
            &["agent.x", "goal.x"],
        );
        let factors = variation_space.resolve(&Default::default(), Key::new(0)).expect("resolving the default factors");
        let spec = EnvSpec {
            id: ENTRY.id.to_owned(),
            action_space: Space::uniform_box([1], DType::Float32, -1.0, 1.0),
            columns: vec![
                ColumnSpec::new("state", DType::Float64, [1]),
                ColumnSpec::new("goal_state", DType::Float64, [1]),
                ColumnSpec::new("noise", DType::Float32, []),
            ],
            observation_space: vec![],
            variation_space,
            max_episode_steps: 12,
            cameras: vec![],
            angles: vec![],
        };
        Self { spec, factors, x: 0.0, goal: 0.0, noise: 0.0, rng: Key::new(0).rng() }
    }

    fn draw(&self, x: f64, frame: FrameMut<'_>) {
        let [r, g, b] = self.factors.rgb("agent.color");
        for pixel in frame.rgb.chunks_exact_mut(3) {
            pixel.copy_from_slice(&[r, g, b.wrapping_add((x * 16.0) as i32 as u8)]);
        }
    }
}

impl Env for Line {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn libraries(&self) -> std::collections::BTreeMap<String, String> {
        [("engine".to_owned(), "2".to_owned())].into()
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        self.factors = self.spec.variation_space.resolve(&options.variation, Key::new(seed))?;
        self.x = self.factors.scalar("agent.x");
        self.goal = self.factors.scalar("goal.x");
        self.rng = Key::new(seed).with("noise").rng();
        self.noise = 0.0;
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let push = action.continuous(1)?[0].clamp(-1.0, 1.0);
        self.x = (self.x + f64::from(push)).clamp(-5.0, 5.0);
        self.noise = self.rng.random();
        let reward = -(self.x - self.goal).abs();
        Ok(Transition { reward, terminated: self.is_success(), truncated: false })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        row.set(0, &[self.x]);
        row.set(1, &[self.goal]);
        row.set(2, &[self.noise as f32]);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.draw(self.x, frame);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.draw(self.goal, frame);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        Snapshot([self.x, self.goal].iter().flat_map(|v| v.to_le_bytes()).collect())
    }

    fn restore(&mut self, _: &Snapshot) -> Result<()> {
        Err(Error::external("restoring", "this environment has no snapshots"))
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        self.x = start.to_f64("state")?[0];
        self.goal = goal.to_f64("state")?[0];
        if start.schema().find("variation_agent_color").is_some() {
            let color = start.to_f64("variation_agent_color")?;
            let request = swm_core::VariationRequest {
                variation: Some(vec![]),
                variation_values: [("agent.color".to_owned(), color)].into(),
            };
            self.factors = self.spec.variation_space.resolve(&request, Key::new(0))?;
        }
        Ok(())
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        self.goal = key.rng().random_range(-4.0..4.0);
        Ok(())
    }

    fn is_success(&self) -> bool {
        (self.x - self.goal).abs() < NEAR
    }

    fn goal_distance(&self) -> f64 {
        (self.x - self.goal).abs()
    }
}

/// A policy that moves straight to the goal.
pub struct Walker;

impl Policy for Walker {
    fn begin(&mut self, _: usize, _: Key) {}

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            let row = infos.row(slot);
            let offset = row.get::<f64>("goal_state")?[0] - row.get::<f64>("state")?[0];
            write_action(&mut actions.row_mut(slot), 0, &[offset.clamp(-1.0, 1.0)]);
        }
        Ok(())
    }
}
