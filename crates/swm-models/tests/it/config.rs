//! Configurations from presets and `key=value` settings, and errors that name the setting.

use swm_models::lewm::Lewm;
use swm_models::{TrainConfig, Trainable as _};

type Config = TrainConfig<Lewm>;

#[test]
fn presets_round_trip_and_settings_override_presets() {
    for preset in Lewm::PRESETS {
        let config = Config::load(preset.id, &[]).expect(preset.id);
        let text = config.to_toml().expect("serialising to TOML");
        let again = toml::from_str::<Config>(&text).expect("parsing the written configuration");
        assert_eq!(again.to_toml().expect("serialising to TOML"), text);
    }
    let settings = ["optim.lr=3e-4".to_owned(), "model.latent=16".to_owned(), "optim.betas=[0.9, 0.99]".to_owned()];
    let config = Config::load("tiny", &settings).expect("loading the configuration");
    assert_eq!((config.optim.lr, config.model.latent, config.optim.betas[1]), (3e-4, 16, 0.99));
}

#[test]
fn errors_name_invalid_settings() {
    let message =
        |setting: &str| Config::load("tiny", &[setting.to_owned()]).expect_err("an invalid setting").to_string();
    assert!(message("optim.rl=1").contains("did you mean optim.lr"), "{}", message("optim.rl=1"));
    assert!(message("optim.lr=fast").contains("optim.lr"), "{}", message("optim.lr=fast"));
    assert!(message("optim.lr").contains("key=value"));
    assert!(message("model.image=60").contains("patches"), "{}", message("model.image=60"));
    assert!(message("data.num_steps=1").contains("at least 2"));
    assert!(Config::load("tniy", &[]).expect_err("no such preset").to_string().contains("did you mean tiny"));
}
