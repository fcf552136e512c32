#![doc = include_str!("README.md")]

pub mod discrete;
mod expert;
mod factors;
mod physics;
mod render;
mod shapes;
mod state;
mod table;

use factors::{ANGLES, columns, index, observation_space, shapes_row, variation_space};
use physics::{AGENT, BLOCK, Simulation, append_items, take_array};
use render::{DrawnState, TableRenderer};
use state::{State, checked, goal_distance, is_reached, set_state, settled, start_state};
use state::{state_distance, state_of, success_distance};
use std::f64::consts::TAU;
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::factors::{from_row, parse_snapshot, snapshot, wrong_snapshot};
use swm_core::{
    Action, DType, Env, EnvEntry, EnvSpec, Error, ExpertEntry, FactorValues, FrameMut, Key, ResetOptions, Result,
    RowMut, RowRef, Snapshot, Space, Transition, VariationRequest,
};
pub use table::{ACTION_SCALE, TABLE};

/// The registry row of this environment.
pub const ENTRY: EnvEntry = EnvEntry {
    id: "swm/PushT-v1",
    summary: "push a block to a goal pose",
    options: &[],
    make: |_| Ok(Box::new(PushT::new())),
    experts: EXPERTS,
};

const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "pushes planned with the environment's own physics",
        tasks: &[],
        make: || Box::new(expert::Pusher::new(|action| action, expert::Pace::FULL)),
    },
    ExpertEntry {
        id: "paper-speed",
        summary: "the pushes of `expert`, at the speed of the published demonstrations",
        tasks: &[],
        make: || Box::new(expert::Pusher::new(|action| action, expert::Pace::PAPER)),
    },
    ExpertEntry {
        id: "weak",
        summary: "random actions that stay near the block",
        tasks: &[],
        make: || Box::new(expert::WeakExpert::default()),
    },
];

/// The maximal number of candidates drawn for a goal.
const GOAL_TRIES: usize = 1000;

/// Push-T, with continuous actions or the action grid of [`discrete`].
pub struct PushT {
    spec: EnvSpec,
    factors: FactorValues,
    simulation: Simulation,
    goal: State,
    /// The state that the goal frame shows.
    goal_drawn: DrawnState,
    /// The number of contacts, summed over the physics steps since the last action.
    contacts: usize,
    /// The `shapes` column.
    shapes: [f64; 4],
    renderer: TableRenderer,
}

impl PushT {
    /// Makes `swm/PushT-v1` with every factor at its default.
    pub fn new() -> Self {
        Self::with_actions(ENTRY.id, Space::uniform_box([2], DType::Float32, -1.0, 1.0))
    }

    /// Makes the environment with another id, and with a box or the grid of [`discrete`] as its action space.
    fn with_actions(id: &'static str, action_space: Space) -> Self {
        let variation_space = variation_space();
        let defaults = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
        let factors = variation_space.resolve(&defaults, Key::new(0)).expect("defaults are in their spaces");
        let goal = start_state(&factors);
        let simulation = settled(table::simulation(&factors), &goal);
        let goal_drawn = DrawnState::of(&simulation);
        let spec = EnvSpec {
            id: id.to_owned(),
            action_space,
            columns: columns(),
            observation_space: observation_space(),
            variation_space,
            max_episode_steps: 200,
            cameras: vec![],
            angles: ANGLES.to_vec(),
        };
        let (renderer, shapes) = (TableRenderer::new(&factors), shapes_row(&factors));
        Self { spec, factors, simulation, goal, goal_drawn, contacts: 0, shapes, renderer }
    }

    fn state(&self) -> State {
        state_of(&self.simulation)
    }

    /// Starts an episode with these factors. The simulation is at the goal afterwards, for the goal frame.
    fn begin(&mut self, factors: FactorValues, goal: State) {
        self.simulation = settled(table::simulation(&factors), &goal);
        self.contacts = self.simulation.contact_count();
        self.goal_drawn = DrawnState::of(&self.simulation);
        self.goal = goal;
        self.renderer.begin_episode(&factors);
        self.shapes = shapes_row(&factors);
        self.factors = factors;
    }
}

impl Default for PushT {
    fn default() -> Self {
        Self::new()
    }
}

/// Draws a goal at rest at which nothing overlaps, and that is not already reached at `start`.
fn find_goal(factors: &FactorValues, start: &State, key: Key) -> Result<State> {
    let space = |name: &str| factors.factors().iter().find(|factor| factor.key == name).map(|factor| &factor.space);
    let (Some(agents), Some(blocks)) = (space("agent.start_position"), space("block.start_position")) else {
        return Err(Error::config("goal", "the factors of the start positions are missing", "report this bug"));
    };
    let mut rng = key.rng();
    let angles = Space::uniform_box([], DType::Float64, 0.0, TAU);
    for _ in 0..GOAL_TRIES {
        let (agent, block, angle) = (agents.sample(&mut rng), blocks.sample(&mut rng), angles.sample(&mut rng));
        let goal = [agent[0], agent[1], block[0], block[1], angle[0], 0.0, 0.0];
        let overlaps = || settled(table::simulation(factors), &goal).contact_count() > 0;
        if !is_reached(factors, &goal, start) && !overlaps() {
            return Ok(goal);
        }
    }
    Err(Error::Unsatisfiable {
        factor: "goal".to_owned(),
        constraint: "agent, block and walls do not overlap".to_owned(),
        tries: GOAL_TRIES,
    })
}

impl Env for PushT {
    fn spec(&self) -> &EnvSpec {
        &self.spec
    }

    fn reset(&mut self, seed: u64, options: &ResetOptions) -> Result<()> {
        let key = Key::new(seed);
        let factors = self.spec.variation_space.resolve(&options.variation, key)?;
        let start = match &options.state {
            Some(state) => checked(state, STATE)?,
            None => start_state(&factors),
        };
        let goal = match &options.goal_state {
            Some(state) => checked(state, GOAL_STATE)?,
            None => find_goal(&factors, &start, key.with("goal"))?,
        };
        self.begin(factors, goal);
        // As in the reference, the simulation continues from the goal, so that the solver's contacts at the goal
        // persist.
        set_state(&mut self.simulation, &start);
        self.simulation.step();
        self.contacts += self.simulation.contact_count();
        Ok(())
    }

    fn step(&mut self, action: Action<'_>) -> Result<Transition> {
        let action = match &self.spec.action_space {
            Space::Box { .. } => action.continuous(2).map(|action| [action[0], action[1]])?,
            grid => discrete::action(action.discrete(grid)?),
        };
        self.contacts = table::advance(&mut self.simulation, action);
        let state = self.state();
        Ok(Transition {
            reward: -state_distance(&self.goal, &state),
            terminated: is_reached(&self.factors, &self.goal, &state),
            truncated: false,
        })
    }

    fn observe(&self, row: &mut RowMut<'_>) {
        let state = self.state();
        let [x, y, block_x, block_y, _, vx, vy] = state;
        let goal = self.goal;
        let goal_position = self.factors.get("goal.position");
        row.set(index::STATE, &state);
        row.set(index::PROPRIO, &[x, y, vx, vy]);
        row.set(index::POS_AGENT, &[x, y]);
        row.set(index::VEL_AGENT, &[vx, vy]);
        row.set(index::BLOCK_POSE, &[block_x, block_y, self.simulation.bodies[BLOCK].angle]);
        row.set(index::GOAL_POSE, &[goal_position[0], goal_position[1], self.factors.scalar("goal.angle")]);
        row.set(index::GOAL_STATE, &goal);
        row.set(index::GOAL_PROPRIO, &[goal[0], goal[1], goal[5], goal[6]]);
        row.set(index::N_CONTACTS, &[self.contacts.div_ceil(table::SUBSTEPS) as i64]);
        row.set(index::SHAPES, &self.shapes);
        row.set(index::AGENT_POSE, &[x, y, self.simulation.bodies[AGENT].angle]);
    }

    fn render(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.renderer.draw(&DrawnState::of(&self.simulation), frame);
        Ok(())
    }

    fn render_goal(&mut self, frame: FrameMut<'_>) -> Result<()> {
        self.renderer.draw(&self.goal_drawn, frame);
        Ok(())
    }

    fn factors(&self) -> &FactorValues {
        &self.factors
    }

    fn snapshot(&self) -> Snapshot {
        let Snapshot(mut bytes) = snapshot(&self.spec.id, &self.factors, []);
        append_items(&mut bytes, &self.goal);
        append_items(&mut bytes, &[self.contacts as u64]);
        self.simulation.save(&mut bytes);
        Snapshot(bytes)
    }

    fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let invalid = || wrong_snapshot(&self.spec.id, "bytes of another length");
        let (factors, mut bytes) = parse_snapshot(&self.spec.id, &self.spec.variation_space, &self.factors, snapshot)?;
        let goal = take_array::<f64, 7>(&mut bytes).ok_or_else(invalid)?;
        let [contacts] = take_array::<u64, 1>(&mut bytes).ok_or_else(invalid)?;
        let goal = checked(&goal, "goal of a snapshot")?;
        let contacts = usize::try_from(contacts).map_err(|_| invalid())?;
        if factors.is_some() || goal != self.goal {
            self.begin(factors.unwrap_or_else(|| self.factors.clone()), goal);
        }
        if self.simulation.load(&mut bytes).is_none() || !bytes.is_empty() {
            // A partly read state is invalid, so the episode starts again at its goal.
            self.begin(self.factors.clone(), goal);
            return Err(wrong_snapshot(&self.spec.id, "bytes of another length"));
        }
        self.contacts = contacts;
        Ok(())
    }

    fn restore_from(&mut self, start: RowRef<'_>, goal: RowRef<'_>) -> Result<()> {
        let factors = from_row(&self.spec.variation_space, &self.factors, start)?;
        let start = checked(&start.to_f64(STATE)?, "state of the start row")?;
        let goal = checked(&goal.to_f64(STATE)?, "state of the goal row")?;
        self.begin(factors, goal);
        // A new simulation without contacts, so that the state equals that of the row to the last bit.
        self.simulation = table::simulation(&self.factors);
        self.contacts = 0;
        set_state(&mut self.simulation, &start);
        Ok(())
    }

    fn sample_goal(&mut self, key: Key) -> Result<()> {
        self.goal = find_goal(&self.factors, &self.state(), key.with("goal"))?;
        self.goal_drawn = DrawnState::of(&settled(table::simulation(&self.factors), &self.goal));
        Ok(())
    }

    fn is_success(&self) -> bool {
        is_reached(&self.factors, &self.goal, &self.state())
    }

    fn goal_distance(&self) -> f64 {
        goal_distance(&self.factors, &self.goal, &self.state())
    }

    fn success_distance(&self) -> f64 {
        success_distance(&self.factors, &self.goal, &self.state())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn snapshot_contains_the_impulses_of_contacts() {
        let mut env = PushT::new();
        let start = vec![256.0, 300.0, 256.0, 256.0, 0.0, 0.0, 0.0];
        env.reset(3, &ResetOptions { state: Some(start), ..ResetOptions::default() })
            .expect("resetting to the start state");
        let push = Action::Continuous(&[0.0, -0.5]);
        (0..3).for_each(|_| {
            env.step(push).expect("stepping the environment");
        });
        assert!(env.contacts > 0, "the agent pushes the block");
        let snapshot = env.snapshot();
        let after = |env: &mut PushT| {
            (0..20).for_each(|_| {
                env.step(push).expect("stepping the environment");
            });
            env.snapshot()
        };
        let expected = after(&mut env);
        let mut restored = PushT::new();
        restored.restore(&snapshot).expect("restoring the snapshot");
        assert_eq!(restored.snapshot(), snapshot);
        assert_eq!(after(&mut restored), expected);
        assert!(restored.restore(&Snapshot(snapshot.0[..snapshot.0.len() - 1].to_vec())).is_err());
        // The same positions and velocities without the solver's contacts continue differently.
        let mut without_contacts = PushT::new();
        without_contacts.restore(&snapshot).expect("restoring the snapshot");
        let state = without_contacts.state();
        without_contacts.simulation = table::simulation(&without_contacts.factors);
        set_state(&mut without_contacts.simulation, &state);
        assert_ne!(after(&mut without_contacts), expected);
    }

    #[test]
    fn expert_reaches_most_goals() {
        let mut env = PushT::new();
        let schema = swm_core::Schema::new(env.spec.columns.clone()).expect("creating the schema");
        let mut row = swm_core::Batch::zeros(&schema, 1);
        let mut reaches = |seed: u64, options: &ResetOptions| {
            let mut expert = (EXPERTS[0].make)();
            expert.begin(Key::new(seed));
            env.reset(seed, options).expect("resetting the environment");
            (0..env.spec.max_episode_steps).any(|_| {
                env.observe(&mut row.row_mut(0));
                let mut action = [0.0; 2];
                expert.act(row.row(0), &mut action).expect("choosing the expert's action");
                env.step(Action::Continuous(&action.map(|v| v as f32))).expect("stepping the environment").terminated
            })
        };
        assert!((0..10).filter(|&seed| reaches(seed, &ResetOptions::default())).count() >= 9);
        // A dynamic agent, which the block pushes back and rotates.
        let pinned = [("agent.shape", 4.0), ("agent.scale", 25.0), ("block.shape", 6.0)];
        let mut square = ResetOptions::default();
        square.variation.variation_values =
            pinned.into_iter().map(|(key, value)| (key.to_owned(), vec![value])).collect();
        assert!((0..10).filter(|&seed| reaches(seed, &square)).count() >= 7);
    }
}
