//! Tests of benchmark reports, with and without a fake reference. The measured times are not tested.

use std::io::Write as _;
use swm_bench::{BenchConfig, bench_envs};
use swm_core::EnvChoice;
use swm_core::run::Control;

/// A native environment whose steps take little time.
fn env() -> EnvChoice {
    EnvChoice::from(swm_envs::ENVS.get("swm/TwoRoom-v1").expect("an environment"))
}

fn config() -> BenchConfig {
    let (sizes, python) = (vec![8], None);
    BenchConfig {
        envs: 2,
        sizes,
        bare: true,
        threads: 1,
        pairs: 3,
        seconds: 0.01,
        episode_steps: 5,
        episodes: 0,
        python,
    }
}

#[test]
fn report_states_that_the_reference_is_missing() {
    let report = bench_envs(&[env()], &config(), &mut Control::new()).expect("the benchmark succeeds");
    assert!(report.reference.contains("SWM_REFERENCE_PYTHON"));
    let works: Vec<_> = report.rows.iter().map(|row| (row.what, row.size)).collect();
    assert_eq!(works, [("step", None), ("step, one thread", None), ("step + render", Some(8))]);
    for row in &report.rows {
        assert_eq!((row.ours.len(), row.reference.len(), row.ratio), (3, 0, None));
        assert!(row.steps_per_second > 0.0);
    }
    let missing = BenchConfig { python: Some("/no/such/python".into()), ..config() };
    let report = bench_envs(&[env()], &missing, &mut Control::new()).expect("the benchmark succeeds");
    assert!(report.reference.contains("/no/such/python"), "{}", report.reference);
}

#[cfg(unix)]
#[test]
fn ratio_is_the_median_over_measurement_pairs() {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let python = folder.path().join("python");
    // A fake reference: prints other text, then answers every request with 10 steps in 2 seconds.
    let script = "#!/bin/sh\necho hello\necho SWM ready 1.2.3\nwhile read line; do echo SWM 10 2.0; done\n";
    let mut file = std::fs::File::create(&python).expect("the file is written");
    file.write_all(script.as_bytes()).expect("the file is written");
    file.set_permissions(std::fs::Permissions::from_mode(0o755)).expect("making the file executable");
    drop(file);
    let report = bench_envs(&[env()], &BenchConfig { python: Some(python), ..config() }, &mut Control::new())
        .expect("the benchmark succeeds");
    assert_eq!(report.reference, "1.2.3");
    for row in &report.rows {
        assert_eq!(row.reference, [5.0; 3]);
        assert_eq!(row.ratio, Some(row.steps_per_second / 5.0));
    }
    assert!(report.to_string().contains("x the reference (median of 3)"), "{report}");
}

#[test]
fn invalid_settings_are_errors() {
    assert!(bench_envs(&[env()], &BenchConfig { pairs: 0, ..config() }, &mut Control::new()).is_err());
    assert!(bench_envs(&[env()], &BenchConfig { seconds: f64::NAN, ..config() }, &mut Control::new()).is_err());
}
