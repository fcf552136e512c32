//! The files of training presets. The first byte of the input is the index of the family.

#![no_main]

use swm_models::FAMILIES;

libfuzzer_sys::fuzz_target!(
    init: {
        for (index, family) in (0..).zip(FAMILIES.rows) {
            for preset in family.presets {
                let name = format!("{}-{}", family.id, preset.id);
                swm_fuzz::seed(&name, &[&[index][..], preset.toml.as_bytes()].concat());
            }
        }
    },
    |bytes: &[u8]| {
        let Some((&index, text)) = bytes.split_first() else { return };
        let Some(family) = FAMILIES.rows.get(usize::from(index)) else { return };
        let path = swm_fuzz::file("preset.toml", text);
        if let Ok(config) = (family.config)(&path.to_string_lossy(), &[]) {
            config.to_commented_toml().expect("TOML of a valid configuration");
        }
    }
);
