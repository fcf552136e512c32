//! Views and wrappers of live environments.

use super::TestLab;
use serde_json::{Value, json};
use swm_core::{Env, Error, Result};
use swm_envs::wrappers::{GoalFrame, Stack, WRAPPERS, read};
use swm_lab::rendering::Wrapping;
use swm_lab::still::StillQuery;

/// The wrappers of the registry, without those that read files.
pub struct Registered;

impl Wrapping for Registered {
    fn listed(&self) -> Value {
        WRAPPERS.rows.iter().map(|row| json!({"id": row.id})).collect()
    }

    fn wrap(&self, env: Box<dyn Env>, wrappers: &[String], wrap_goal: bool) -> Result<Box<dyn Env>> {
        if wrappers.iter().any(|text| read(text).is_ok_and(|(entry, _)| entry.reads_files())) {
            return Err(Error::config("wrapper", "it reads files", "choose another"));
        }
        Ok(Stack::parse(wrappers)?.wrap(env, if wrap_goal { GoalFrame::Wrapped } else { GoalFrame::Clean }))
    }

    fn manifest(&self, wrappers: &[String]) -> Result<Value> {
        Ok(json!(wrappers))
    }
}

#[test]
fn wrappers_change_frames_in_their_order_and_are_in_the_command() {
    let lab = TestLab::start();
    let still = |query: &str| {
        let (status, png) = lab.get(&format!("api/still?env=swm/PushT-v1&seed=2&image=48{query}"));
        assert_eq!(status, 200, "{query}: {}", String::from_utf8_lossy(&png));
        png
    };
    let plain = still("");
    let stacked = still("&wrappers=cutout,size=0.5;blur,kernel=9");
    assert_eq!(stacked, still("&wrappers=cutout,size=0.5;blur,kernel=9;"), "equal stacks have equal bytes");
    let others = [&plain, &still("&wrappers=blur,kernel=9;cutout,size=0.5"), &still("&wrappers=blur,kernel=9")];
    assert!(others.iter().all(|other| **other != stacked));
    let goal = still("&goal=true");
    assert_eq!(still("&goal=true&wrappers=grayscale"), goal);
    assert_ne!(still("&goal=true&wrappers=grayscale&wrap_goal=true"), goal);
    // What `swm frame` renders.
    let query = StillQuery {
        env: "swm/PushT-v1".to_owned(),
        seed: 2,
        image: Some(48),
        wrappers: "cutout,size=0.5;blur,kernel=9".to_owned(),
        ..StillQuery::default()
    };
    let choice = swm_envs::ENVS.choose(&query.env).expect("an environment");
    let mut env = Stack::parse(&["cutout,size=0.5", "blur,kernel=9"])
        .expect("wrappers")
        .wrap(choice.env().expect("an environment"), GoalFrame::Clean);
    assert_eq!(query.still().and_then(|still| still.png(&mut *env)).expect("a frame"), stacked);
    let (_, command) = lab.get("api/command?env=swm/PushT-v1&wrappers=noise,std=8;blur&wrap_goal=true");
    let expected =
        "swm frame swm/PushT-v1 --seed 0 --wrapper noise,std=8 --wrapper blur --wrap-goal --output frame.png";
    assert_eq!(String::from_utf8_lossy(&command), expected);
}

#[test]
fn a_live_environment_is_wrapped_and_recorded_with_its_wrappers() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    live.reply("started");
    let (_, plain) = live.frame(|header| header["step"] == 0.0);
    live.send(&json!({"type": "reset", "seed": 0, "wrappers": "grayscale"}));
    let started = live.reply("started");
    assert_eq!(started["python"], Value::Null);
    assert!(started["command"].to_string().contains("--wrapper grayscale"), "{started}");
    live.send(&json!({"type": "drive", "by": "expert"}));
    live.send(&json!({"type": "record", "dataset": "grey"}));
    live.reply("recording");
    live.send(&json!({"type": "step"}));
    let (_, grey) = live.frame(|header| header["step"] == 1.0);
    assert_ne!(plain, grey);
    // The frames of a dataset are all of one kind.
    live.send(&json!({"type": "reset", "seed": 0, "wrappers": ""}));
    assert!(live.reply("failed")["message"].to_string().contains("finish the recording"));
    live.send(&json!({"type": "keep"}));
    while live.reply("recording")["episodes"] != 1 {}
    live.send(&json!({"type": "finish"}));
    while live.reply("recording")["dataset"] != Value::Null {}
    let path = lab.home.path().join("datasets/grey.lance");
    let manifest = swm_data::open(swm_data::Location::from(path)).expect("a dataset").manifest().expect("a manifest");
    assert_eq!((&manifest.config["wrappers"], &manifest.config["wrap_goal"]), (&json!(["grayscale"]), &json!(false)));
    // A plain recording is another dataset.
    live.send(&json!({"type": "reset", "seed": 0}));
    live.send(&json!({"type": "record", "dataset": "grey"}));
    assert!(live.reply("failed")["message"].to_string().contains("choose another name"));
}

#[test]
fn wrappers_are_listed() {
    let lab = TestLab::start();
    assert!(lab.json("api/wrappers").as_array().is_some_and(|all| all.iter().any(|one| one["id"] == "noise")));
}
