//! The files of recipes.

#![no_main]

use swm::cli::check_recipe;

/// What the recipes of the repository do not have.
const SEED: &str = r#"summary = "s"
recorded-on = "x86_64 avx512"
[[collect]]
name = "rooms"
env = "swm/TwoRoom-v1"
policy = "expert"
episodes = 3
sample = ["agent.color", "all"]
pin = ["wall.axis=1", "agent.color=1,2,3"]
wrapper = "noise,std=3"
image = 32
[[train]]
name = "sac"
model = "sac"
env = "swm/TwoRoom-v1"
[train.settings]
schedule.steps = 9
optim = { lr = 1e-3 }
[[eval]]
name = "found"
policies = ["sac", "random"]
env = "swm/TwoRoom-v1"
dataset = "rooms"
solver = "cem,samples=16,elites=4"
term = "goal,when=closest,weight=2"
each-factor = true
"#;

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::seed_files("crates/swm/recipes", ".toml");
        swm_fuzz::seed("all", SEED.as_bytes());
    },
    |bytes: &[u8]| {
        if let Ok(text) = std::str::from_utf8(bytes) {
            let _ = check_recipe("recipe.toml", text);
        }
    }
);
