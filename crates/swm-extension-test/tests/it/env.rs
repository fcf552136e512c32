//! The environment `ext/Line-v0`: actions move a point on a line to a goal position.

use swm::core::columns::STATE;
use swm::core::env::{Action, FrameMut, ResetOptions, Snapshot, Transition};
use swm::core::{
    ColumnSpec, DType, Env, EnvEntry, EnvSpec, Error, Factor, FactorValues, Key, Result, Space, VariationSpace,
};

pub const ENTRY: EnvEntry = EnvEntry {
    id: "ext/Line-v0",
    summary: "move a point on a line to a goal",
    options: &[],
    make: |_| Ok(Box::new(Line::new()?)),
    experts: &[],
};

/// Distance to the goal below which an episode succeeds.
const TOLERANCE: f64 = 0.1;
/// Movement of the point per unit of action.
const STEP: f64 = 0.3;

struct Line {
    spec: EnvSpec,
    factors: FactorValues,
    position: f64,
    goal: f64,
}

impl Line {
    fn new() -> Result<Self> {
        let unit = || Space::uniform_box([1], DType::Float64, -1.0, 1.0);
        let factors = vec![Factor::new("start", unit(), [-0.5]), Factor::new("goal", unit(), [0.5])];
        let variation_space = VariationSpace::new(factors, &["start", "goal"]);
        let spec = EnvSpec {
            id: ENTRY.id.to_owned(),
            action_space: Space::uniform_box([1], DType::Float32, -1.0, 1.0),
            columns: vec![ColumnSpec::new(STATE, DType::Float32, [1]), ColumnSpec::new("target", DType::Float32, [1])],
            observation_space: vec![(STATE, unit())],
            variation_space,
            max_episode_steps: 50,
            cameras: vec![],
            angles: vec![],
        };
        let factors = spec.variation_space.resolve(&Default::default(), Key::new(0))?;
        Ok(Self { spec, factors, position: 0.0, goal: 0.0 })
    }
}

impl Env for Line {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        self.factors = self.spec.variation_space.resolve(&options.variation, Key::new(seed).with("factors"))?;
        let chosen = |state: &Option<Vec<f64>>, factor| {
            state.as_ref().and_then(|state| state.first().copied()).unwrap_or(factor)
        };
        self.position = chosen(&options.state, self.factors.scalar("start"));
        self.goal = chosen(&options.goal_state, self.factors.scalar("goal"));
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = f64::from(action.continuous(1)?[0]).clamp(-1.0, 1.0);
        self.position = (self.position + STEP * action).clamp(-2.0, 2.0);
        Ok(Transition { reward: -self.goal_distance(), terminated: self.is_success(), truncated: false })
    }

    fn observe(&self, row: &mut swm::core::RowMut<'_>) {
        row.set(0, &[self.position as f32]);
        row.set(1, &[self.goal as f32]);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        frame.rgb.fill(((self.position + 2.0) * 60.0) as u8);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        frame.rgb.fill(((self.goal + 2.0) * 60.0) as u8);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        Snapshot([self.position, self.goal].iter().flat_map(|value| value.to_le_bytes()).collect())
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let [position, goal] = snapshot.0.as_chunks::<8>().0 else {
            let given = format!("a snapshot of {} bytes", snapshot.0.len());
            return Err(Error::mismatch("restoring ext/Line-v0", given, "16 bytes"));
        };
        (self.position, self.goal) = (f64::from_le_bytes(*position), f64::from_le_bytes(*goal));
        Ok(())
    }

    fn restore_from(&mut self, start: swm::core::RowRef<'_>, goal: swm::core::RowRef<'_>) -> Result<()> {
        (self.position, self.goal) = (start.to_f64(STATE)?[0], goal.to_f64(STATE)?[0]);
        Ok(())
    }

    fn sample_goal(&mut self, _: Key) -> Result<()> {
        self.goal = if self.position > 0.0 { -0.8 } else { 0.8 };
        Ok(())
    }

    fn is_success(&self) -> bool {
        self.goal_distance() < TOLERANCE
    }

    fn goal_distance(&self) -> f64 {
        (self.position - self.goal).abs()
    }
}
