//! Settings of wrappers: documentation, allowed values and errors.

use super::{has_ffmpeg, make, variants};
use serde_json::{Value, json};
use swm_envs::wrappers::{WRAPPERS, parse};

#[test]
fn every_wrapper_and_parameter_is_tested_and_documented() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let variants = variants(folder.path());
    let docs = include_str!("../../../../../docs/wrappers.md");
    assert_eq!(WRAPPERS.rows.len(), 11);
    for entry in WRAPPERS.rows {
        let texts: Vec<&str> =
            variants.iter().map(|(text, _)| &text[..]).filter(|text| make(text).id() == entry.id).collect();
        assert!(!texts.is_empty(), "{} is tested", entry.id);
        assert!(!entry.summary.is_empty() && docs.contains(&format!("`{}`", entry.id)), "{} is in the docs", entry.id);
        let described = entry.describe();
        for parameter in entry.parameters {
            let name = parameter.name;
            assert!(texts.iter().any(|text| text.contains(&format!(",{name}="))), "{}: {name} is tested", entry.id);
            let row = format!(
                "| `{name}` | {} | {} | {} |",
                parameter.summary,
                parameter.default.map_or("must be given".to_owned(), |default| format!("`{default}`")),
                parameter.domain
            );
            assert!(docs.contains(&row), "docs/wrappers.md contains, under {}:\n{row}", entry.id);
            assert_eq!(described["parameters"][name]["default"], parameter.default_value());
        }
    }
}

#[test]
#[allow(clippy::too_many_lines, reason = "one table of settings and errors")]
fn invalid_settings_are_errors_that_name_the_setting() {
    let message = |text: &str| match parse(text) {
        Ok(_) => panic!("{text} is accepted"),
        Err(error) => {
            assert!(error.is_usage(), "{text}: {error}");
            error.to_string()
        }
    };
    let error_contains = |text: &str, words: &[&str]| {
        let message = message(text);
        words.iter().for_each(|word| assert!(message.contains(word), "{text}: {message}"));
    };
    error_contains("nose", &["wrapper", "'nose'", "noise", "swm wrappers"]);
    error_contains("noise,sdt=8", &["'sdt'", "std", "are kind, std, amount"]);
    error_contains("chroma-key,color=1/2/3", &["'color'", "key_color"]);
    error_contains("grayscale,keep=1", &["'keep'", "has no parameters"]);
    error_contains("noise,8", &["'8'", "NAME=VALUE"]);
    error_contains("noise,std=1,std=2", &["'std=1'", "'std=2'", "twice"]);
    error_contains("chroma-key,key_color=1/2/3", &["'media' is missing", "PNG"]);
    for (text, given, allowed) in [
        ("noise,std=-1", "-1", "from 0 to 255"),
        ("noise,std=256", "256", "from 0 to 255"),
        ("noise,std=nan", "nan", "from 0 to 255"),
        ("noise,std=loud", "loud", "linear/START/END/STEPS"),
        ("noise,std=linear/0/300/9", "linear/0/300/9", "from 0 to 255"),
        ("noise,std=linear/0/30/0", "linear/0/30/0", "STEPS"),
        ("noise,std=linear/0/30", "linear/0/30", "STEPS"),
        ("noise,std=exponential/10/1.5/0", "exponential/10/1.5/0", "DECAY"),
        ("noise,amount=2", "2", "from 0 to 1"),
        ("noise,kind=pink", "pink", "gaussian or salt-pepper"),
        ("blur,kernel=0", "0", "an integer from 1 to 99"),
        ("blur,kernel=2.5", "2.5", "an integer from 1 to 99"),
        ("blur,sigma=-1", "-1", "from 0 to 100"),
        ("color-jitter,brightness=-0.1", "-0.1", "from 0 to 9"),
        ("color-jitter,brightness=1.2/0.8", "1.2/0.8", "low/high"),
        ("color-jitter,hue=0.6", "0.6", "from -0.5 to 0.5"),
        ("color-jitter,hue=0.1/0.2/0.3", "0.1/0.2/0.3", "low/high"),
        ("random-shift,pad=-1", "-1", "from 0 to 1024"),
        ("random-shift,resample=never", "never", "episode or step"),
        ("cutout,size=0.5/1.1", "0.5/1.1", "from 0 to 1"),
        ("cutout,color=256", "256", "0 to 255"),
        ("occlusion,color=1/2", "1/2", "red/green/blue"),
        ("occlusion,num_patches=1e9", "1000000000", "an integer"),
        ("moving-patch,speed=inf", "inf", "from 0 to 1000"),
        ("random-conv,kernel_size=16", "16", "from 1 to 15"),
        ("resolution,scale=2", "2", "from 0 to 1"),
        ("chroma-key,media=a.png,key_color=1/2/3/4", "1/2/3/4", "red/green/blue"),
        ("chroma-key,media=,key_color=1/2/3", "media", "a path"),
    ] {
        let name = text.split([',', '=']).nth(1).expect("the name of a parameter");
        let name = if text.starts_with("chroma-key") && given.contains('/') { "key_color" } else { name };
        error_contains(text, &[text.split(',').next().expect("the name of a wrapper"), name, given, allowed]);
    }
    // The same settings as JSON.
    let json = |id: &str, settings: Value| {
        let settings = settings.as_object().expect("a JSON object").clone();
        WRAPPERS.get(id).expect("finding the wrapper").make(&settings).err().map(|error| error.to_string())
    };
    assert_eq!(json("noise", json!({"std": ["cosine", 1, 2, 3], "amount": 1})), None);
    assert_eq!(json("cutout", json!({"size": [0, 1.0], "color": [1, 2, 3], "num": 2})), None);
    for (id, name, settings) in [
        ("noise", "std", json!({"std": "8"})),
        ("noise", "std", json!({"std": null})),
        ("noise", "std", json!({"std": {"low": 1}})),
        ("noise", "strength", json!({"strength": 1})),
        ("blur", "kernel", json!({"kernel": true})),
        ("cutout", "color", json!({"color": [1, 2.5, 3]})),
        ("cutout", "size", json!({"size": []})),
        ("chroma-key", "media", json!({"media": 3, "key_color": [1, 2, 3]})),
        ("chroma-key", "key_color", json!({"media": "a", "key_color": []})),
    ] {
        let message = json(id, settings.clone()).unwrap_or_else(|| panic!("{id} accepts {settings}"));
        assert!(message.contains(name), "{message}");
    }
}

#[test]
fn missing_and_damaged_backgrounds_are_errors_that_name_the_file() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let message = |name: &str| {
        let text = format!("chroma-key,key_color=0/0/0,media={}", folder.path().join(name).display());
        parse(&text).err().unwrap_or_else(|| panic!("{name} is accepted")).to_string()
    };
    assert!(message("").contains("no PNG file"), "{}", message(""));
    std::fs::write(folder.path().join("damaged.png"), b"\x89PNG and nothing else").expect("writing the file");
    assert!(message("missing.png").contains("missing.png"));
    assert!(message("missing.mp4").contains("No such file"));
    assert!(message("damaged.png").contains("readable PNG file"));
    assert!(message("").contains("damaged.png"));
    if has_ffmpeg() {
        std::fs::write(folder.path().join("damaged.mp4"), b"no video").expect("writing the file");
        assert!(message("damaged.mp4").contains("ffmpeg can decode"), "{}", message("damaged.mp4"));
    }
}
