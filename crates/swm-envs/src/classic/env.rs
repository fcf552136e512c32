//! An environment of any [`World`].

use super::picture::Picture;
use super::{World, factors};
use rand::Rng as _;
use rand::seq::IndexedRandom as _;
use swm_core::factors as values;
use swm_core::{
    Action, ColumnSpec, DType, Env, EnvSpec, Error, FactorValues, FrameMut, Key, ResetOptions, Result, Rng, RowMut,
    RowRef, Snapshot, Space, Transition, VariationRequest,
};

/// Paths from which [`Env::sample_goal`] takes a goal before it gives up.
const GOAL_TRIES: u64 = 16;
/// How often chance acts where the expert goes: in a world without chance there is one way, and few goals.
const CHANCE: f64 = 0.02;
/// The most steps of such a path.
const GOAL_STEPS: usize = 200;

/// Places in [`EnvSpec::columns`].
mod columns {
    pub const STATE: usize = 0;
    pub const GOAL_STATE: usize = 1;
    pub const PHYSICS: usize = 2;
}

/// A world, where it is and where it should go.
pub struct Classic<W: World> {
    spec: EnvSpec,
    factors: FactorValues,
    /// The values of [`World::PHYSICS`].
    physics: Vec<f32>,
    world: W,
    state: W::State,
    goal: W::State,
    /// Made when the first frame is asked for.
    picture: Option<Picture>,
    /// Whether `picture` shows this episode's background and colours.
    current: bool,
}

/// The bounds of a `state` column, in single precision as the reference has them.
#[allow(clippy::cast_possible_truncation)]
fn observed<W: World>() -> Space {
    let (low, high) = W::OBSERVED.iter().map(|&(low, high)| (f64::from(low as f32), f64::from(high as f32))).unzip();
    Space::Box { shape: vec![W::OBSERVED.len()], dtype: DType::Float32, low, high }
}

impl<W: World> Classic<W> {
    /// The world with every factor at its default.
    pub fn new() -> Self {
        let spec = EnvSpec {
            id: W::ID.to_owned(),
            action_space: W::action_space(),
            columns: vec![
                ColumnSpec::new("state", DType::Float32, [W::OBSERVED.len()]),
                ColumnSpec::new("goal_state", DType::Float32, [W::OBSERVED.len()]),
                ColumnSpec::new("physics", DType::Float32, [W::PHYSICS.len()]),
            ],
            observation_space: vec![("state", observed::<W>())],
            variation_space: factors::space::<W>(),
            max_episode_steps: W::LIMIT,
            cameras: vec![],
        };
        let none = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = spec.variation_space.resolve(&none, Key::new(0)).expect("defaults are in their spaces");
        let physics = factors::physics::<W>(&factors);
        let world = W::new(&physics);
        let mut rng = Key::new(0).rng();
        let (state, goal) = (W::start(&mut rng), W::task(&mut rng));
        Self { spec, factors, physics, world, state, goal, picture: None, current: false }
    }

    /// Makes the world that of these factors, at this state.
    fn arrange(&mut self, factors: FactorValues, state: W::State, goal: W::State) {
        // Most episodes look like the one before.
        self.current &= factors.iter().eq(self.factors.iter());
        self.physics = factors::physics::<W>(&factors);
        self.world = W::new(&self.physics);
        (self.factors, self.state, self.goal) = (factors, state, goal);
    }

    fn show(&mut self, state: W::State, frame: FrameMut<'_>) {
        let picture = self.picture.get_or_insert_with(|| Picture::new(W::SIZE));
        if !self.current {
            picture.begin(|surface| self.world.draw_background(surface), &factors::swaps::<W>(&self.factors));
            self.current = true;
        }
        picture.show(|surface| self.world.draw(&state, surface), frame);
    }

    /// The states the world comes through within some steps: in the first tries while the expert carries out a task,
    /// in the later ones by chance. What ends an episode is left out unless it is the task's goal; in the last tries
    /// nothing is.
    #[allow(clippy::cast_possible_truncation)]
    fn path(&self, rng: &mut Rng, attempt: u64) -> Vec<W::State> {
        let (expert, everything) = (attempt < GOAL_TRIES / 2, attempt >= GOAL_TRIES * 3 / 4);
        let (mut state, task, mut path) = (self.state, W::task(rng), vec![]);
        while path.len() < GOAL_STEPS {
            let action = if expert && !rng.random_bool(CHANCE) {
                self.world.control(&state, &task)
            } else {
                self.spec.action_space.sample(rng)[0]
            };
            let ended = self.world.step(&mut state, f64::from(action as f32)).terminated;
            let reached = self.world.reached(&state, &task);
            if reached || !ended || everything {
                path.push(state);
            }
            if (reached && expert) || (ended && !everything) {
                break;
            }
        }
        path
    }

    /// A goal as everybody else sees it: through the `goal_state` column.
    fn seen(&self, state: &W::State) -> Result<W::State> {
        let mut row = [0.0; MAX_OBSERVED];
        W::observe(state, &mut row[..W::OBSERVED.len()]);
        W::parse("a sampled goal", &row.map(f64::from)[..W::OBSERVED.len()])
    }
}

/// The most numbers a `state` column has.
const MAX_OBSERVED: usize = 8;

impl<W: World> Env for Classic<W> {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        let key = Key::new(seed);
        let factors = self.spec.variation_space.resolve(&options.variation, key)?;
        let state = match &options.state {
            Some(state) => W::parse("state", state)?,
            None => W::start(&mut key.with("start").rng()),
        };
        let goal = match &options.goal_state {
            Some(goal) => W::parse("goal_state", goal)?,
            None => W::task(&mut key.with("task").rng()),
        };
        self.arrange(factors, state, goal);
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = match self.spec.action_space {
            Space::Box { .. } => f64::from(action.continuous(1)?[0]),
            #[allow(clippy::cast_precision_loss)]
            _ => action.discrete(&self.spec.action_space)?[0] as f64,
        };
        Ok(self.world.step(&mut self.state, action))
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        W::observe(&self.state, row.at(columns::STATE));
        W::observe(&self.goal, row.at(columns::GOAL_STATE));
        row.set(columns::PHYSICS, &self.physics);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.show(self.state, frame);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.show(self.goal, frame);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        let numbers = self.state.as_ref().iter().chain(self.goal.as_ref());
        values::snapshot(W::ID, &self.factors, numbers.flat_map(|number| number.to_le_bytes()))
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let (factors, rest) = values::restored(W::ID, &self.spec.variation_space, &self.factors, snapshot)?;
        let (mut state, mut goal) = (W::State::default(), W::State::default());
        let numbers = state.as_mut().iter_mut().chain(goal.as_mut());
        let (chunks, tail) = rest.as_chunks();
        if chunks.len() != numbers.size_hint().0 || !tail.is_empty() {
            return Err(values::foreign(W::ID, format!("{} bytes of state and goal", rest.len())));
        }
        numbers.zip(chunks).for_each(|(number, &bytes)| *number = f64::from_le_bytes(bytes));
        match factors {
            Some(factors) => self.arrange(factors, state, goal),
            None => (self.state, self.goal) = (state, goal),
        }
        Ok(())
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        let state = W::parse("state", &start.to_f64("state")?)?;
        let goal = W::parse("goal state", &goal.to_f64("state")?)?;
        let factors = values::from_row(&self.spec.variation_space, &self.factors, start)?;
        self.arrange(factors, state, goal);
        Ok(())
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        for attempt in 0..GOAL_TRIES {
            let mut rng = key.at(attempt).rng();
            let mut goals = self.path(&mut rng, attempt);
            goals.retain_mut(|goal| match self.seen(goal) {
                Ok(seen) if !self.world.reached(&self.state, &seen) => {
                    *goal = seen;
                    true
                }
                _ => false,
            });
            if let Some(&goal) = goals.choose(&mut rng) {
                self.goal = goal;
                return Ok(());
            }
        }
        Err(Error::Unsatisfiable {
            factor: "goal".to_owned(),
            constraint: "on the way of the expert or of chance, and not reached already".to_owned(),
            tries: GOAL_TRIES as usize,
        })
    }

    fn is_success(&self) -> bool {
        self.world.reached(&self.state, &self.goal)
    }

    fn goal_distance(&self) -> f64 {
        self.world.distance(&self.state, &self.goal)
    }
}
