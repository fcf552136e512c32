//! Push-T compared with rollouts that the Python reference recorded (pymunk 7.3).

use swm_conformance::golden::{self, Golden, image_difference};
use swm_core::{Action, Batch, Env, EnvEntry, FrameMut, ResetOptions, Schema, VariationRequest};
use swm_envs::push_t;

/// An environment with a row for its observations.
struct Probe {
    env: Box<dyn Env>,
    row: Batch,
}

impl Probe {
    fn new(entry: &EnvEntry, options: &ResetOptions) -> Self {
        let mut env = entry.env().expect("creating the environment");
        env.reset(0, options).expect("resetting to the recorded start");
        let schema = Schema::new(env.spec().columns.clone()).expect("creating the schema");
        Self { env, row: Batch::zeros(&schema, 1) }
    }

    fn observe(&mut self, column: &str) -> Vec<f64> {
        self.env.observe(&mut self.row.row_mut(0));
        self.row.row(0).to_f64(column).expect("reading the column")
    }

    fn frame(&mut self) -> Vec<u8> {
        let mut rgb = vec![0; 224 * 224 * 3];
        self.env.render(FrameMut::new(224, 224, &mut rgb)).expect("rendering a frame");
        rgb
    }
}

/// Returns the largest absolute difference of two rows.
fn max_difference(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn contacts_follow_the_reference() {
    let files = golden::files(env!("CARGO_MANIFEST_DIR"), "pusht-contact");
    assert!(!files.is_empty(), "the golden files in `tests/golden` are missing");
    for file in files {
        let mut golden = Golden::open(&file);
        for pair in golden.names().iter().filter_map(|name| name.strip_suffix(".state")) {
            // A pair is named `b<block shape>a<agent shape>`.
            let shapes: Vec<f64> =
                pair[1..].split('a').map(|shape| shape.parse().expect("parsing a shape index")).collect();
            let case = format!("{}, {pair}", file.display());
            let mut read = |name: &str| golden.read::<f64>(&format!("{pair}.{name}"));
            let [states, rewards, start, goal] = ["state", "reward", "start", "goal"].map(&mut read);
            let actions = golden.read::<f32>(&format!("{pair}.action"));
            let terminations = golden.read::<bool>(&format!("{pair}.terminated"));
            let contacts = golden.read::<i64>(&format!("{pair}.n_contacts"));
            let shapes = [("block.shape".to_owned(), vec![shapes[0]]), ("agent.shape".to_owned(), vec![shapes[1]])];
            let options = ResetOptions {
                variation: VariationRequest { variation: Some(vec![]), variation_values: shapes.into() },
                state: Some(start),
                goal_state: Some(goal),
            };
            let mut probe = Probe::new(&push_t::ENTRY, &options);

            let mut errors = vec![max_difference(&states[..4], &probe.observe("state")[..4])];
            assert!(errors[0] < 1e-6, "{case}: off by {} at the reset", errors[0]);
            let mut touched = false;
            for (t, action) in actions.chunks_exact(2).enumerate() {
                let transition = probe.env.step(Action::Continuous(action)).expect("stepping the environment");
                let (expected, state) = (&states[7 * (t + 1)..][..7], probe.observe("state"));
                let error = max_difference(&expected[..4], &state[..4]);
                errors.push(error);
                touched |= contacts[t] > 0;
                assert!(touched || error < 1e-6, "{case}: off by {error} at {t}, before any contact");
                if max_difference(expected, &state) < 1e-6 {
                    assert!((transition.reward - rewards[t]).abs() < 1e-6, "{case}: reward {t}");
                    assert_eq!(transition.terminated, terminations[t], "{case}: terminated {t}");
                    assert_eq!(transition.terminated, probe.env.is_success(), "{case}: success {t}");
                    assert_eq!(probe.observe("n_contacts"), [contacts[t] as f64], "{case}: contacts {t}");
                }
            }
            // On x86-64 Linux all errors are 0; elsewhere sine and cosine may round differently.
            errors.sort_by(f64::total_cmp);
            let median = errors[errors.len() / 2];
            assert!(median < 0.1, "{case}: median error {median} px");
        }
    }
}

#[test]
fn rollouts_and_frames_follow_the_reference() {
    let files = golden::files(env!("CARGO_MANIFEST_DIR"), "swm_PushT-v1-");
    assert!(files.len() >= 2, "the golden files in `tests/golden` are missing");
    for file in files {
        let mut golden = Golden::open(&file);
        let name = file.display();
        let columns = [
            "obs.state",
            "obs.proprio",
            "info.pos_agent",
            "info.vel_agent",
            "info.block_pose",
            "info.goal_pose",
            "info.goal_state",
            "info.goal_proprio",
            "info.n_contacts",
        ];
        let expected = columns.map(|column| golden.read::<f64>(column));
        let goals = golden.read::<f64>("info.goal_state");
        let variation = golden.variation();
        let options = ResetOptions { variation, state: None, goal_state: Some(goals[..7].to_vec()) };
        let mut probe = Probe::new(&push_t::ENTRY, &options);
        let follows = |probe: &mut Probe, t: usize| {
            for (column, rows) in columns.iter().zip(&expected) {
                let got = probe.observe(&column[column.find('.').map_or(0, |dot| dot + 1)..]);
                let n = got.len();
                let error = max_difference(&got, &rows[n * t..][..n]);
                assert!(error < 1e-6, "{name}: {column} {t} is off by {error}");
            }
        };
        follows(&mut probe, 0);
        let first = image_difference(&probe.frame(), &golden.read("frame_first"));
        let (rewards, terminations) = (golden.read::<f64>("reward"), golden.read::<bool>("terminated"));
        for (t, action) in golden.read::<f32>("action").chunks_exact(2).enumerate() {
            let transition = probe.env.step(Action::Continuous(action)).expect("stepping the environment");
            follows(&mut probe, t + 1);
            assert!((transition.reward - rewards[t]).abs() < 1e-6, "{name}: reward {t}");
            assert_eq!(transition.terminated, terminations[t], "{name}: terminated {t}");
        }
        let last = image_difference(&probe.frame(), &golden.read("frame_last"));
        assert!(first < 0.1 && last < 0.1, "{name}: frames differ by {first} and {last} of 255");
    }
}

#[test]
fn discrete_actions_follow_the_reference() {
    let files = golden::files(env!("CARGO_MANIFEST_DIR"), "swm_PushT-Discrete-v1-");
    assert!(files.len() >= 4, "the golden files in `tests/golden` are missing");
    for file in files {
        let mut golden = Golden::open(&file);
        let name = file.display();
        let goal_state = Some(golden.read::<f64>("goal_state"));
        let options = ResetOptions { variation: golden.variation(), state: None, goal_state };
        let mut probe = Probe::new(&push_t::discrete::ENTRY, &options);
        let first = image_difference(&probe.frame(), &golden.read("frame_first"));
        let (states, contacts) = (golden.read::<f64>("info.state"), golden.read::<i64>("info.n_contacts"));
        let (rewards, terminations) = (golden.read::<f64>("reward"), golden.read::<bool>("terminated"));
        let mut errors = vec![max_difference(&states[..7], &probe.observe("state"))];
        for (t, action) in golden.read::<i64>("action").chunks_exact(2).enumerate() {
            let transition = probe.env.step(Action::Discrete(action)).expect("stepping the environment");
            errors.push(max_difference(&states[7 * (t + 1)..][..7], &probe.observe("state")));
            assert!((transition.reward - rewards[t]).abs() < 1e-6, "{name}: reward {t}");
            assert_eq!(transition.terminated, terminations[t], "{name}: terminated {t}");
            assert_eq!(probe.observe("n_contacts"), [contacts[t + 1] as f64], "{name}: contacts {t}");
        }
        let last = image_difference(&probe.frame(), &golden.read("frame_last"));
        let worst = errors.iter().copied().fold(0.0, f64::max);
        assert!(worst < 1e-6, "{name}: the state is off by {worst}");
        assert!(first < 0.1 && last < 0.1, "{name}: frames differ by {first} and {last} of 255");
    }
}
