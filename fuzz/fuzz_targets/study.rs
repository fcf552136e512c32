//! The files of studies.

#![no_main]

use std::path::Path;
use swm::cli::study::check_text;

/// What the studies of the repository do not have.
const SEED: &str = r#"title = "t"
question = "q?"
families = ["policy", "seed"]
[[collect]]
name = "rooms"
env = "swm/TwoRoom-v1"
episodes = 3
[defaults]
env = "swm/TwoRoom-v1"
episodes = 3
seed = [1, 2]
[[starts]]
name = "drawn"
[[condition]]
name = "plain"
[[condition]]
name = "{factor} {colour}"
each = { factor = "factors", colour = ["red", "hsv(180,1,1)"] }
sample = "{factor}"
pin = "agent.color={colour}"
[[policy]]
name = "m{training-seed}"
policy = "m{training-seed}"
each = { training-seed = [0, 1] }
solver = "cem,samples=16,elites=4"
[[published]]
source = "a paper"
rates = { plain = { m0 = 0.5 } }
[small.defaults]
episodes = 1
"#;

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::seed_files("crates/swm/studies", ".toml");
        swm_fuzz::seed("all", SEED.as_bytes());
    },
    |bytes: &[u8]| {
        if let Ok(text) = std::str::from_utf8(bytes) {
            let _ = [true, false].map(|small| check_text(text, Path::new("study.toml"), small));
        }
    }
);
