//! The checks. Each goes through every row and panics, with the environment's id, where one does not keep a promise.

use crate::Worlds;
use swm_core::batch::{Batch, ColumnSpec, DType, Schema};
use swm_core::columns::flat_factor;
use swm_core::policy::{ExpertPolicy, Policy, RandomPolicy};
use swm_core::pool::{Reset, threads};
use swm_core::{
    Action, Env, EnvEntry, EnvPool, Factor, FrameMut, Key, ResetOptions, Snapshot, Space, VariationRequest,
    VariationSpace,
};

fn vary(keys: &[&str]) -> VariationRequest {
    VariationRequest {
        variation: Some(keys.iter().map(|&key| key.to_owned()).collect()),
        ..VariationRequest::default()
    }
}

fn all_varied() -> ResetOptions {
    ResetOptions { variation: vary(&["all"]), ..ResetOptions::default() }
}

/// One environment, seen from outside.
struct Probe {
    env: Box<dyn Env>,
    row: Batch,
    /// Height and width of its pictures.
    size: (usize, usize),
}

impl Probe {
    fn new(worlds: &Worlds, entry: &EnvEntry) -> Self {
        let env = entry.env().unwrap_or_else(|error| panic!("{}: {error}", entry.id));
        let schema = Schema::new(env.spec().columns.clone()).expect("columns have their own names");
        Self { env, row: Batch::zeros(&schema, 1), size: worlds.size }
    }

    fn reset(worlds: &Worlds, entry: &EnvEntry, seed: u64, options: &ResetOptions) -> Self {
        let mut probe = Self::new(worlds, entry);
        probe.env.reset(seed, options).unwrap_or_else(|error| panic!("{}, seed {seed}: {error}", entry.id));
        probe
    }

    fn column(&mut self, name: &str) -> Vec<f64> {
        self.env.observe(&mut self.row.row_mut(0));
        self.row.row(0).to_f64(name).expect("a declared column")
    }

    fn observed(&mut self) -> &Batch {
        self.env.observe(&mut self.row.row_mut(0));
        &self.row
    }

    fn picture(&mut self) -> Vec<u8> {
        let (height, width) = self.size;
        let mut rgb = vec![0; height * width * 3];
        self.env.render(FrameMut::new(width, height, &mut rgb)).expect("a picture");
        rgb
    }

    fn goal_picture(&mut self) -> Vec<u8> {
        let (height, width) = self.size;
        let mut rgb = vec![0; height * width * 3];
        self.env.render_goal(FrameMut::new(width, height, &mut rgb)).expect("a picture");
        rgb
    }

    /// A random action, the `t`-th of a sequence.
    fn step(&mut self, key: Key, t: u64) -> swm_core::Transition {
        self.act(&self.env.spec().action_space.sample(&mut key.at(t).rng()))
    }

    #[allow(clippy::cast_possible_truncation)]
    fn act(&mut self, action: &[f64]) -> swm_core::Transition {
        let numbers: Vec<f32> = action.iter().map(|&v| v as f32).collect();
        let choice: Vec<i64> = action.iter().map(|&v| v as i64).collect();
        let action = match self.env.spec().action_space {
            Space::Box { .. } => Action::Continuous(&numbers),
            _ => Action::Discrete(&choice),
        };
        self.env.step(action).expect("an action of the action space")
    }

    /// Everything one can see, as bytes.
    fn everything(&mut self) -> Vec<u8> {
        let mut bytes = bytes_of(self.observed());
        bytes.extend(self.picture());
        bytes.extend(self.goal_picture());
        bytes.push(u8::from(self.env.is_success()));
        bytes
    }
}

/// The mean absolute difference of two pictures, of 255.
#[allow(clippy::cast_precision_loss)]
fn picture_difference(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len(), "pictures of one size");
    a.iter().zip(b).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum::<f64>() / a.len() as f64
}

fn bytes_of(batch: &Batch) -> Vec<u8> {
    (0..batch.schema().columns().len()).flat_map(|column| batch.bytes(column)).copied().collect()
}

fn assert_finite(batch: &Batch, what: &str) {
    for column in batch.schema().columns() {
        let value = batch.row(0).to_f64(&column.name).expect("a column");
        assert!(value.iter().all(|v| v.is_finite()), "{what}: {} = {value:?}", column.name);
    }
}

/// Rows say what they are: ids, actions, columns, factors, experts.
pub fn rows_declare_what_they_are(worlds: &Worlds) {
    for entry in worlds.rows {
        let (env, id) = (entry.env().expect("an environment"), entry.id);
        let spec = env.spec();
        assert_eq!(spec.id, id);
        assert_eq!(worlds.rows.iter().filter(|other| other.id == id).count(), 1, "{id} is listed once");
        assert!(!entry.summary.is_empty(), "{id} says what one does there");
        assert!(spec.max_episode_steps > 0, "{id}");
        let schema = Schema::new(spec.columns.clone()).unwrap_or_else(|error| panic!("{id}: {error}"));
        assert!(schema.find("state").is_some(), "{id} observes its state");
        let fitting = match spec.action_space {
            Space::Box { dtype, .. } => dtype == DType::Float32,
            Space::Discrete { .. } | Space::MultiDiscrete { .. } => true,
            Space::Rgb => false,
        };
        assert!(fitting, "{id}: actions are a float32 box, discrete or multi-discrete");
        assert!(!worlds.demonstrated || !entry.experts.is_empty(), "{id} has an expert");
        for (i, expert) in entry.experts.iter().enumerate() {
            assert!(entry.experts[..i].iter().all(|other| other.id != expert.id), "{id}: two experts '{}'", expert.id);
            assert!(!expert.summary.is_empty(), "{id}: {} says how it acts", expert.id);
        }
        assert!(!spec.variation_space.factors().is_empty(), "{id} has factors of variation");
    }
}

/// Plays episodes with random actions in a pool; what every episode produced, step after step, as bytes.
fn play(worlds: &Worlds, entry: &EnvEntry, slots: &[u64], workers: usize, steps: usize) -> Vec<Vec<u8>> {
    let envs = slots.iter().map(|_| entry.env().expect("an environment")).collect();
    let mut pool =
        EnvPool::new(envs, Some(worlds.size), Some(steps), threads(workers).expect("threads")).expect("a pool");
    let mut policy = RandomPolicy::new(pool.spec(), slots.len());
    let mut actions = Batch::zeros(&Schema::new([pool.spec().action_column()]).expect("a schema"), slots.len());
    let resets: Vec<Reset> = slots
        .iter()
        .enumerate()
        .map(|(slot, &episode)| {
            policy.begin(slot, Key::new(episode));
            // Every other episode varies everything.
            let options = if episode % 2 == 0 { ResetOptions::default() } else { all_varied() };
            Reset { slot, seed: episode, options }
        })
        .collect();
    pool.reset(&resets).expect("a reset");
    let mut seen = vec![vec![]; slots.len()];
    let mut look = |pool: &EnvPool| {
        for (slot, seen) in seen.iter_mut().enumerate() {
            for (column, spec) in pool.infos().schema().columns().iter().enumerate() {
                let n = spec.row_bytes();
                seen.extend_from_slice(&pool.infos().bytes(column)[slot * n..(slot + 1) * n]);
            }
        }
    };
    look(&pool);
    for _ in 0..steps {
        let active = vec![true; slots.len()];
        policy.act(pool.infos(), &active, &mut actions).expect("random actions");
        pool.step(&actions, &active).expect("a step");
        look(&pool);
    }
    seen
}

/// Threads and neighbours in a pool change nothing, by the byte.
pub fn results_do_not_depend_on_threads_or_neighbours(worlds: &Worlds) {
    for entry in worlds.rows {
        let episodes = [0, 1, 2, 3, 4];
        let steps = usize::try_from(worlds.steps).expect("a few steps");
        let one_thread = play(worlds, entry, &episodes, 1, steps);
        assert!(one_thread == play(worlds, entry, &episodes, 4, steps), "{}: four threads differ from one", entry.id);
        assert!(one_thread[0] != one_thread[2], "{}: two seeds give two episodes", entry.id);
        let backwards = play(worlds, entry, &[4, 3, 2, 1, 0], 2, steps);
        for (i, &episode) in episodes.iter().enumerate() {
            assert!(
                one_thread[i] == play(worlds, entry, &[episode], 1, steps)[0],
                "{}: episode {episode} alone",
                entry.id
            );
            assert!(one_thread[i] == backwards[4 - i], "{}: episode {episode} in another slot", entry.id);
        }
    }
}

/// Environments that take turns, and those with a past, do what fresh ones do.
pub fn environments_share_nothing_and_forget_the_past(worlds: &Worlds) {
    for entry in worlds.rows {
        let key = Key::new(7);
        let alone = |seed| {
            let mut probe = Probe::reset(worlds, entry, seed, &all_varied());
            (0..6).map(|t| (probe.step(key, t).reward, probe.everything()).1).collect::<Vec<_>>()
        };
        let wanted = [alone(1), alone(2)];
        // Taking turns with another one, in environments with a past.
        let mut pair =
            [Probe::reset(worlds, entry, 90, &all_varied()), Probe::reset(worlds, entry, 91, &ResetOptions::default())];
        for (i, probe) in pair.iter_mut().enumerate() {
            (0..5).for_each(|t| {
                probe.step(key, 100 + t);
            });
            probe.picture();
            probe.env.reset(i as u64 + 1, &all_varied()).expect("a reset");
        }
        for t in 0..6 {
            for (probe, wanted) in pair.iter_mut().zip(&wanted) {
                probe.step(key, t as u64);
                assert!(probe.everything() == wanted[t], "{}: step {t} differs", entry.id);
            }
        }
    }
}

/// Rows and pictures do not depend on what was in the memory before.
pub fn rows_and_pictures_are_written_completely(worlds: &Worlds) {
    for entry in worlds.rows {
        let mut probe = Probe::reset(worlds, entry, 3, &all_varied());
        probe.step(Key::new(0), 0);
        let [zeros, ones] = [0, 255].map(|fill| {
            for column in 0..probe.row.schema().columns().len() {
                probe.row.bytes_mut(column).fill(fill);
            }
            bytes_of(probe.observed())
        });
        assert!(zeros == ones, "{}: observe leaves bytes as they were", entry.id);
        for &(height, width) in worlds.sizes {
            let mut draw = |fill, goal| {
                let mut rgb = vec![fill; height * width * 3];
                let frame = FrameMut::new(width, height, &mut rgb);
                if goal {
                    probe.env.render_goal(frame).expect("a picture")
                } else {
                    probe.env.render(frame).expect("a picture")
                }
                rgb
            };
            assert!(draw(0, false) == draw(255, false), "{}: {height} x {width} picture", entry.id);
            assert!(draw(0, true) == draw(255, true), "{}: {height} x {width} goal picture", entry.id);
        }
    }
}

/// Actions of the wrong kind, length or value are refused, and the world stays as it was.
pub fn wrong_actions_are_errors_and_change_nothing(worlds: &Worlds) {
    for entry in worlds.rows {
        let mut probe = Probe::reset(worlds, entry, 0, &ResetOptions::default());
        let before = probe.env.snapshot();
        let n = probe.env.spec().action_dim();
        let space = probe.env.spec().action_space.clone();
        let wrong: Vec<Action<'_>> = match space {
            Space::Discrete { .. } | Space::MultiDiscrete { .. } => {
                let ends = |past: i64| {
                    let end = |i| if past < 0 { space.bounds(i).0 as i64 - 1 } else { space.bounds(i).1 as i64 + 1 };
                    Action::Discrete((0..n).map(end).collect::<Vec<_>>().leak())
                };
                vec![ends(-1), ends(1), Action::Discrete(vec![0; n + 1].leak()), Action::Continuous(&[0.0])]
            }
            _ => vec![
                Action::Discrete(&[0]),
                Action::Continuous(&[]),
                Action::Continuous(vec![0.0; n + 1].leak()),
                Action::Continuous(vec![f32::NAN; n].leak()),
                Action::Continuous(vec![f32::INFINITY; n].leak()),
                Action::Continuous(vec![f32::NEG_INFINITY; n].leak()),
            ],
        };
        for action in wrong {
            let error = probe.env.step(action).expect_err("a wrong action").to_string();
            assert!(error.len() > 10, "{}: {error}", entry.id);
            assert!(probe.env.snapshot() == before, "{}: {action:?} changed the world", entry.id);
        }
        if let Space::Box { .. } = probe.env.spec().action_space {
            // Far outside, but finite: an error, or a world that is still finite.
            let _ = probe.env.step(Action::Continuous(&vec![1e6; n]));
            assert_finite(probe.observed(), entry.id);
        }
    }
}

/// What follows a restored snapshot is what followed it the first time.
pub fn what_follows_a_restore_followed_the_snapshot(worlds: &Worlds) {
    for entry in worlds.rows {
        for (seed, options) in [(0, ResetOptions::default()), (1, all_varied()), (2, all_varied())] {
            let key = Key::new(seed);
            let mut probe = Probe::reset(worlds, entry, seed, &options);
            (0..5).for_each(|t| {
                probe.step(key, t);
            });
            probe.env.sample_goal(key).expect("a goal");
            let snapshot = probe.env.snapshot();
            let follow = |probe: &mut Probe| {
                let mut seen = probe.everything();
                for t in 5..5 + worlds.steps {
                    let transition = probe.step(key, t);
                    seen.extend(transition.reward.to_le_bytes());
                    seen.extend([u8::from(transition.terminated), u8::from(transition.truncated)]);
                    seen.extend(probe.everything());
                }
                seen
            };
            let wanted = follow(&mut probe);
            let mut other = Probe::reset(worlds, entry, 77, &all_varied());
            for (probe, who) in
                [(&mut probe, "the same"), (&mut other, "another"), (&mut Probe::new(worlds, entry), "a new")]
            {
                probe.env.restore(&snapshot).expect("an own snapshot");
                assert!(probe.env.snapshot() == snapshot, "{}: {who} environment", entry.id);
                assert!(follow(probe) == wanted, "{}: {who} environment goes on differently", entry.id);
            }
            let factors = |probe: &Probe| probe.env.factors().iter().map(|(_, v)| v.to_vec()).collect::<Vec<_>>();
            assert_eq!(factors(&probe), factors(&other), "{}: factors are part of the state", entry.id);
        }
        let mut probe = Probe::reset(worlds, entry, 0, &ResetOptions::default());
        let whole = probe.env.snapshot().0;
        for bytes in [vec![], b"another world".to_vec(), whole[..whole.len() - 1].to_vec()] {
            assert!(probe.env.restore(&Snapshot(bytes)).is_err(), "{}: a foreign snapshot is refused", entry.id);
        }
    }
}

/// Goals are new, follow their key, look like the place, and count when reached.
pub fn sampled_goals_are_new_and_count_when_reached(worlds: &Worlds) {
    for entry in worlds.rows {
        let mut distinct = 0;
        for seed in 0..worlds.goals {
            let options = if seed % 2 == 0 { ResetOptions::default() } else { all_varied() };
            let mut probe = Probe::reset(worlds, entry, seed, &options);
            let (id, key) = (entry.id, Key::new(seed).with("goal"));
            let (state, picture) = (probe.column("state"), probe.env.snapshot());
            probe.env.sample_goal(key).unwrap_or_else(|error| panic!("{id}, seed {seed}: {error}"));
            assert_eq!(probe.column("state"), state, "{id}: choosing a goal moves nothing");
            assert!(!probe.env.is_success(), "{id}, seed {seed}: the goal is reached already");
            assert!(probe.env.snapshot() != picture, "{id}: the goal is part of the state");
            let goal = probe.column("goal_state");
            probe.env.sample_goal(key).expect("the same goal");
            assert_eq!(probe.column("goal_state"), goal, "{id}: one key, one goal");
            let goal_picture = probe.goal_picture();
            probe.env.sample_goal(key.at(1)).expect("another goal");
            distinct += u64::from(probe.column("goal_state") != goal);

            // Standing at the goal is success, however one gets there, and looks like the goal picture.
            let there = ResetOptions { state: Some(goal.clone()), goal_state: Some(goal.clone()), ..options };
            let mut there = Probe::reset(worlds, entry, seed, &there);
            assert!(there.env.is_success(), "{id}, seed {seed}: reset to the goal is success");
            let schema = Schema::new([ColumnSpec::new("state", DType::Float64, [goal.len()])]).expect("a schema");
            let mut row = Batch::zeros(&schema, 1);
            row.get_mut("state").expect("the state").copy_from_slice(&goal);
            there.env.restore_from(row.row(0), row.row(0)).expect("a row");
            assert!(there.env.is_success(), "{id}, seed {seed}: restore to the goal is success");
            let apart = picture_difference(&there.picture(), &goal_picture);
            assert!(apart < 1.0, "{id}, seed {seed}: the goal looks otherwise ({apart} of 255)");
        }
        let goals = worlds.goals;
        assert!(distinct * 20 >= goals * 19, "{}: {distinct} of {goals} keys give different goals", entry.id);
    }
}

/// A dataset row of what a probe shows: `state` and all factors, numbers in `dtype` where they are not whole.
#[allow(clippy::cast_possible_truncation)]
fn dataset_row(probe: &mut Probe, dtype: DType) -> Batch {
    let mut values = vec![("state".to_owned(), probe.column("state"))];
    values.extend(probe.env.factors().iter().map(|(key, value)| (flat_factor(key), value.to_vec())));
    let columns: Vec<ColumnSpec> =
        values.iter().map(|(name, value)| ColumnSpec::new(name.clone(), dtype, [value.len()])).collect();
    let mut row = Batch::zeros(&Schema::new(columns).expect("a schema"), 1);
    for (name, value) in &values {
        if dtype == DType::Float64 {
            row.get_mut(name).expect("a column").copy_from_slice(value);
        } else {
            let value: Vec<f32> = value.iter().map(|&v| v as f32).collect();
            row.get_mut(name).expect("a column").copy_from_slice(&value);
        }
    }
    row
}

/// A row of a dataset brings back the world it was recorded in.
pub fn dataset_rows_bring_back_their_world(worlds: &Worlds) {
    for entry in worlds.rows {
        for seed in 0..worlds.rows_restored {
            let (id, key) = (entry.id, Key::new(seed));
            let mut probe = Probe::reset(worlds, entry, seed, &all_varied());
            let start = probe.column("state");
            let [exact, single] = [DType::Float64, DType::Float32].map(|dtype| dataset_row(&mut probe, dtype));
            (0..8).for_each(|t| {
                probe.step(key, t);
            });
            let goal = dataset_row(&mut probe, DType::Float64);
            // The same by way of a reset: pictures may show the goal, so it must be the same, too.
            let factors = probe.env.factors().iter().map(|(key, value)| (key.to_owned(), value.to_vec()));
            let variation = VariationRequest { variation: Some(vec![]), variation_values: factors.collect() };
            let options =
                ResetOptions { variation, state: Some(start.clone()), goal_state: Some(probe.column("state")) };
            let mut wanted = Probe::reset(worlds, entry, seed, &options);
            let mut other = Probe::new(worlds, entry);
            for (row, tolerance) in [(&exact, 0.0), (&single, 1e-4)] {
                other.env.restore_from(row.row(0), goal.row(0)).unwrap_or_else(|error| panic!("{id}: {error}"));
                let apart = other.column("state").iter().zip(&start).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(apart <= tolerance, "{id}, seed {seed}: the state is {apart} off");
                for ((key, got), (_, wanted)) in other.env.factors().iter().zip(wanted.env.factors().iter()) {
                    let apart = got.iter().zip(wanted).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    assert!(apart <= tolerance, "{id}, seed {seed}: {key} is {got:?}, not {wanted:?}");
                }
                let pictures = [(other.picture(), wanted.picture()), (other.goal_picture(), wanted.goal_picture())];
                for (picture, wanted) in pictures {
                    let apart = picture_difference(&picture, &wanted);
                    assert!(apart < 1.0, "{id}, seed {seed}: the picture differs by {apart} of 255");
                }
            }
        }
        let nothing = Batch::zeros(&Schema::new([ColumnSpec::new("place", DType::Float64, [2])]).expect("a schema"), 1);
        let error = Probe::new(worlds, entry).env.restore_from(nothing.row(0), nothing.row(0)).expect_err("no state");
        assert!(error.to_string().contains("state"), "{}: {error}", entry.id);
    }
}

/// Everything pinned to its default, but what hides other factors is switched on.
fn shown(space: &VariationSpace) -> VariationRequest {
    let mut request = vary(&[]);
    for factor in space.factors().iter().filter(|factor| factor.key.starts_with("rendering.")) {
        request.variation_values.insert(factor.key.clone(), vec![factor.space.bounds(0).1]);
    }
    request
}

/// What a request leads to: the picture, everything observed, and everything observed after some steps and a new goal.
fn outcome(worlds: &Worlds, entry: &EnvEntry, variation: VariationRequest) -> Option<(Vec<u8>, Vec<u8>, Vec<u8>)> {
    let mut probe = Probe::new(worlds, entry);
    probe.env.reset(5, &ResetOptions { variation, ..ResetOptions::default() }).ok()?;
    let (picture, row) = (probe.picture(), bytes_of(probe.observed()));
    (0..4).for_each(|t| {
        probe.step(Key::new(5), t);
    });
    probe.env.sample_goal(Key::new(5)).ok()?;
    let later = bytes_of(probe.observed());
    Some((picture, row, later))
}

/// How often another value of a factor changed something, beside the given values of the others.
#[derive(Default)]
struct Effects {
    tried: usize,
    picture: usize,
    row: usize,
    later: usize,
}

fn effects(worlds: &Worlds, entry: &EnvEntry, factor: &Factor, beside: &VariationRequest) -> Effects {
    let mut effects = Effects::default();
    let Some(base) = outcome(worlds, entry, beside.clone()) else { return effects };
    let mut rng = Key::new(1).with(&factor.key).rng();
    for _ in 0..600 {
        let value = factor.space.sample(&mut rng);
        if effects.tried == worlds.values {
            break;
        }
        if beside.variation_values.get(&factor.key).unwrap_or(&factor.init_value) == &value {
            continue;
        }
        let mut request = beside.clone();
        request.variation_values.insert(factor.key.clone(), value);
        // Constraints may forbid a value beside those of the others.
        let Some(outcome) = outcome(worlds, entry, request) else { continue };
        effects.tried += 1;
        effects.picture += usize::from(outcome.0 != base.0);
        effects.row += usize::from(outcome.1 != base.1);
        effects.later += usize::from(outcome.2 != base.2);
    }
    effects
}

/// Every factor changes something, and colours change pictures alone.
pub fn factors_change_what_they_name(worlds: &Worlds) {
    for entry in worlds.rows {
        let space = entry.env().expect("an environment").spec().variation_space.clone();
        let defaults = shown(&space);
        // Some factors show beside certain values of others only, such as the angle of what is round by default.
        let mut contexts = vec![defaults.clone()];
        for seed in 0..worlds.contexts {
            let mut request = shown(&space);
            for (key, value) in space.resolve(&vary(&["all"]), Key::new(seed)).expect("a sample").iter() {
                request.variation_values.entry(key.to_owned()).or_insert_with(|| value.to_vec());
            }
            contexts.push(request);
        }
        for factor in space.factors() {
            let id = format!("{}, {}", entry.id, factor.key);
            if let Some((_, _, why)) = worlds.idle.iter().find(|(env, key, _)| *env == entry.id && *key == factor.key) {
                let mut all = contexts.iter().map(|context| effects(worlds, entry, factor, context));
                assert!(all.all(|e| e.picture + e.row + e.later == 0), "{id} changes something, but {why}");
                continue;
            }
            let Effects { tried, picture, row, later } = effects(worlds, entry, factor, &defaults);
            assert!(tried > 0, "{id}: no value fits beside the defaults");
            let name = factor.key.rsplit('.').next().unwrap_or_default();
            if name.ends_with("color") {
                assert_eq!((picture, row, later), (tried, 0, 0), "{id} changes the picture and nothing else");
            } else if ["size", "scale", "radius", "thickness", "shape", "axis"].contains(&name) {
                assert!(picture * 4 >= tried * 3, "{id} changes the picture ({picture} of {tried} times)");
            } else if name.ends_with("position") {
                assert_eq!(picture.max(row), tried, "{id} changes the picture or the state");
            } else {
                let mut all = contexts.iter().map(|context| effects(worlds, entry, factor, context));
                assert!(all.any(|e| e.picture + e.row + e.later > 0), "{id} changes something");
            }
        }
    }
}

/// Any factor, group or all of them can be sampled.
pub fn random_variations_never_fail(worlds: &Worlds) {
    for entry in worlds.rows {
        let mut probe = Probe::new(worlds, entry);
        let space = probe.env.spec().variation_space.clone();
        let mut keys: Vec<String> = vec!["all".to_owned()];
        for factor in space.factors() {
            keys.push(factor.key.clone());
            keys.extend(factor.key.split_once('.').map(|(group, _)| group.to_owned()));
        }
        keys.dedup();
        let requests = (0..10 * worlds.requests)
            .map(|_| "all")
            .chain(keys.iter().flat_map(|key| vec![key.as_str(); worlds.requests]));
        for (seed, key) in (0..).zip(requests) {
            let options = ResetOptions { variation: vary(&[key]), ..ResetOptions::default() };
            let what = format!("{}, '{key}', seed {seed}", entry.id);
            probe.env.reset(seed, &options).unwrap_or_else(|error| panic!("{what}: {error}"));
            let chosen = space.select(key).expect("a known key");
            for (i, (factor, (_, value))) in space.factors().iter().zip(probe.env.factors().iter()).enumerate() {
                factor.space.check(&factor.key, value).unwrap_or_else(|error| panic!("{what}: {error}"));
                assert!(chosen.contains(&i) || value == factor.init_value, "{what}: {} varies, too", factor.key);
            }
            assert_finite(probe.observed(), &what);
            (0..3).for_each(|t| {
                probe.step(Key::new(seed), t);
            });
            assert_finite(probe.observed(), &what);
        }
    }
}

/// Resets with everything varied succeed.
pub fn many_resets_of_everything_never_fail(worlds: &Worlds) {
    let resets = worlds.resets;
    let check = |entry: &EnvEntry, seeds: std::ops::Range<u64>| {
        let (mut probe, options) = (Probe::new(worlds, entry), all_varied());
        for seed in seeds {
            probe.env.reset(seed, &options).unwrap_or_else(|error| panic!("{}, seed {seed}: {error}", entry.id));
            let values = probe.env.factors();
            for (factor, (key, value)) in values.factors().iter().zip(values.iter()) {
                factor.space.check(key, value).unwrap_or_else(|error| panic!("{}, seed {seed}: {error}", entry.id));
            }
            assert!(probe.env.goal_distance().is_finite(), "{}, seed {seed}", entry.id);
        }
    };
    std::thread::scope(|scope| {
        for half in [0..resets / 2, resets / 2..resets] {
            let check = &check;
            scope.spawn(move || worlds.rows.iter().for_each(|entry| check(entry, half.clone())));
        }
    });
}

/// Groups, factors and pinned values of one request go together.
pub fn groups_single_factors_and_pinned_values_go_together(worlds: &Worlds) {
    for entry in worlds.rows {
        let mut probe = Probe::new(worlds, entry);
        let space = probe.env.spec().variation_space.clone();
        let factors = space.factors();
        let groups: std::collections::BTreeSet<&str> = factors.iter().filter_map(|f| f.key.split('.').next()).collect();
        for (seed, group) in (0..).zip(groups) {
            // A group and one factor of another group vary; a colour is pinned to what another seed draws.
            let inside = |factor: &&Factor| factor.key.starts_with(&format!("{group}."));
            let other = factors.iter().find(|factor| !inside(factor));
            let drawn = space.resolve(&vary(&["all"]), Key::new(1000 + seed)).expect("a sample");
            let mut request = vary(&[group]);
            request.variation.iter_mut().for_each(|keys| keys.extend(other.map(|factor| factor.key.clone())));
            let pinned = factors
                .iter()
                .filter(inside)
                .chain(factors.iter().rev().filter(|f| !inside(f)))
                .find(|factor| factor.key.ends_with("color") && other.is_none_or(|other| other.key != factor.key));
            request.variation_values.extend(pinned.map(|factor| (factor.key.clone(), drawn.get(&factor.key).to_vec())));
            let what = format!("{}, {request:?}", entry.id);
            let options = ResetOptions { variation: request.clone(), ..ResetOptions::default() };
            probe.env.reset(seed, &options).unwrap_or_else(|error| panic!("{what}: {error}"));
            for (factor, (key, value)) in factors.iter().zip(probe.env.factors().iter()) {
                if let Some(wanted) = request.variation_values.get(key) {
                    assert_eq!(value, wanted, "{what}: {key} is pinned");
                } else if !inside(&factor) && other.is_none_or(|other| other.key != key) {
                    assert_eq!(value, factor.init_value, "{what}: {key} is not asked for");
                }
            }
        }
    }
}

/// Acts with the first expert for one episode; whether the goal was reached.
fn follow_expert(entry: &EnvEntry, probe: &mut Probe, seed: u64) -> bool {
    let mut expert = (entry.experts[0].make)();
    expert.begin(Key::new(seed));
    let spec = probe.env.spec().clone();
    let mut action = vec![0.0; spec.action_dim()];
    (0..spec.max_episode_steps).any(|_| {
        expert.act(probe.observed().row(0), &mut action).expect("an action");
        probe.act(&action);
        let distance = probe.env.goal_distance();
        assert!(distance.is_finite() && distance >= 0.0, "{}, seed {seed}: goal distance {distance}", entry.id);
        probe.env.is_success()
    })
}

/// The distance to the goal is positive before it, near 0 at it, and smaller where an expert reached it.
pub fn goal_distances_fall_to_the_goal(worlds: &Worlds) {
    for entry in worlds.rows {
        let mut reached = 0;
        for seed in 0..6.min(worlds.goals) {
            let (id, key) = (entry.id, Key::new(seed).with("goal"));
            let options = if seed < 4 { ResetOptions::default() } else { all_varied() };
            let mut probe = Probe::reset(worlds, entry, seed, &options);
            probe.env.sample_goal(key).unwrap_or_else(|error| panic!("{id}, seed {seed}: {error}"));
            let before = probe.env.goal_distance();
            assert!(before.is_finite() && before > 0.0, "{id}, seed {seed}: {before} from a goal not reached");
            let goal = probe.column("goal_state");
            let there = ResetOptions { state: Some(goal.clone()), goal_state: Some(goal), ..options };
            let there = Probe::reset(worlds, entry, seed, &there).env.goal_distance();
            assert!((0.0..=0.05 * before).contains(&there), "{id}, seed {seed}: {there} at the goal, {before} before");
            if !entry.experts.is_empty() && follow_expert(entry, &mut probe, seed) {
                reached += 1;
                let after = probe.env.goal_distance();
                assert!(
                    after < before,
                    "{id}, seed {seed}: {after} where the expert reached the goal, {before} before"
                );
            }
        }
        assert!(reached > 0 || entry.experts.is_empty(), "{}: its expert reaches a goal", entry.id);
    }
}

/// Unknown factors, values out of bounds and states of the wrong form are refused.
pub fn impossible_resets_are_errors(worlds: &Worlds) {
    for entry in worlds.rows {
        let mut probe = Probe::reset(worlds, entry, 0, &ResetOptions::default());
        let mut refuse = |options: ResetOptions, words: &str| {
            let error = probe.env.reset(0, &options).expect_err(words).to_string();
            assert!(error.contains(words), "{}: {error}", entry.id);
        };
        refuse(ResetOptions { variation: vary(&["no.such.factor"]), ..ResetOptions::default() }, "no.such.factor");
        let space = entry.env().expect("an environment").spec().variation_space.clone();
        for factor in space.factors() {
            let low = factor.space.bounds(0).0 - 1.0;
            for value in [vec![low; factor.space.len()], vec![f64::NAN; factor.space.len()], vec![]] {
                let mut variation = vary(&[]);
                variation.variation_values.insert(factor.key.clone(), value);
                refuse(ResetOptions { variation, ..ResetOptions::default() }, &factor.key);
            }
        }
        let n = probe.column("state").len();
        for state in [vec![], vec![0.0; n + 1], vec![f64::NAN; n]] {
            for goal in [false, true] {
                let (state, goal_state) = if goal { (None, Some(state.clone())) } else { (Some(state.clone()), None) };
                let options = ResetOptions { state, goal_state, ..ResetOptions::default() };
                assert!(probe.env.reset(0, &options).is_err(), "{}: {options:?}", entry.id);
            }
        }
    }
}

/// Experts act within the action space, whoever else is played.
pub fn experts_stay_in_the_action_space_and_follow_their_key(worlds: &Worlds) {
    for entry in worlds.rows {
        for expert in entry.experts {
            let run = |slots: usize| {
                let envs = (0..slots).map(|_| entry.env().expect("an environment")).collect();
                let mut pool = EnvPool::new(envs, None, None, threads(2).expect("threads")).expect("a pool");
                let spec = pool.spec().clone();
                let mut policy = ExpertPolicy::new(&spec, (0..slots).map(|_| (expert.make)()).collect());
                let mut actions = Batch::zeros(&Schema::new([spec.action_column()]).expect("a schema"), slots);
                let mut taken = vec![];
                let resets: Vec<Reset> =
                    (0..slots).map(|slot| Reset { slot, seed: slot as u64, options: all_varied() }).collect();
                pool.reset(&resets).expect("a reset");
                (0..slots).for_each(|slot| policy.begin(slot, Key::new(slot as u64)));
                for _ in 0..30 {
                    policy.act(pool.infos(), &vec![true; slots], &mut actions).expect("an action");
                    for slot in 0..slots {
                        let action = actions.row(slot).to_f64("action").expect("actions");
                        let what = format!("{}, {}", entry.id, expert.id);
                        spec.action_space.check(&what, &action).unwrap_or_else(|error| panic!("{error}"));
                    }
                    taken.push(actions.row(0).to_f64("action").expect("actions"));
                    pool.step(&actions, &vec![true; slots]).expect("a step");
                }
                taken
            };
            assert_eq!(run(1), run(3), "{}, {}: neighbours matter", entry.id, expert.id);
        }
    }
}
