//! Configurations from presets and `key=value` settings, and errors that name the setting.

use swm_models::lewm::Lewm;
use swm_models::{FAMILIES, TrainConfig, Trainable as _};

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
    for setting in ["schedule.floor=-1", "schedule.floor=2"] {
        assert!(message(setting).contains("schedule.floor"), "{}", message(setting));
        let inverse = swm_models::inverse::InverseConfig::load(&[setting.to_owned()]);
        assert!(inverse.expect_err(setting).to_string().contains("schedule.floor"));
    }
    for setting in
        ["optim.clip=-1", "optim.clip=0", "optim.weight_decay=-1", "optim.betas=[2, 0.5]", "optim.betas=[0.9, 1]"]
    {
        let name = setting.split_once('=').expect("a value").0;
        assert!(message(setting).contains(name), "{}", message(setting));
        // Inverse dynamics has a training loop of its own.
        let inverse = swm_models::inverse::InverseConfig::load(&[setting.to_owned()]);
        assert!(inverse.expect_err(setting).to_string().contains(name));
    }
    assert!(Config::load("tniy", &[]).expect_err("no such preset").to_string().contains("did you mean tiny"));
}

/// Appends the dotted keys of a table, with their values.
fn settings(prefix: &str, table: &toml::Table, out: &mut Vec<(String, toml::Value)>) {
    for (key, value) in table {
        let key = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        match value {
            toml::Value::Table(table) => settings(&key, table, out),
            value => out.push((key, value.clone())),
        }
    }
}

#[test]
fn every_setting_can_be_given_alone() {
    for family in FAMILIES.rows {
        for preset in family.presets {
            let load = |settings: &[String]| (family.config)(preset.id, settings).and_then(|config| config.to_toml());
            let text = load(&[]).expect("a preset");
            let mut found = vec![];
            settings("", &text.parse().expect("TOML"), &mut found);
            assert!(found.len() > 10, "{}", family.id);
            for (key, value) in found {
                let given = format!("{key}={value}");
                match load(std::slice::from_ref(&given)) {
                    Ok(again) => assert_eq!(again, text, "{} {}: {given}", family.id, preset.id),
                    Err(error) => panic!("{} {}: {given}: {error}", family.id, preset.id),
                }
            }
        }
    }
}

#[test]
fn validation_needs_no_other_setting_of_its_table() {
    for family in FAMILIES.rows.iter().filter(|family| family.borrows_encoder.is_none()) {
        for setting in ["validation.every=10", "validation.batches=2"] {
            let settings = [setting.to_owned(), "data.hold_out=true".to_owned()];
            if let Err(error) = (family.config)(family.presets[0].id, &settings) {
                panic!("{}: {setting}: {error}", family.id);
            }
        }
    }
}
