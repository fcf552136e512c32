//! `swm collect --resume` with the dataset alone: the arguments that its manifest records, in the words of the command line.

use super::CollectArgs;
use crate::cli::config::VariationArgs;
use crate::cli::wrappers::{WrapperArgs, shown};
use crate::cli::{output, usage};
use crate::home;
use crate::resolver::check_wrapper;
use clap::Parser;
use serde::Deserialize;
use swm_core::{Error, Manifest, Origin, Result, VariationRequest};
use swm_data::lance::shard_manifest;
use swm_data::{ImageCodec, Location};
use swm_envs::wrappers;
use swm_eval::{Choice, PolicyChoice};

/// What to do if the dataset records too little.
const NAME_ALL: &str =
    "give the environment and the options with which it began: swm collect ENV --output DATASET --resume …";

/// The settings of a collection, as the configuration of its manifest holds them.
#[derive(Deserialize)]
struct Recorded {
    env: String,
    policy: PolicyChoice,
    episodes: usize,
    #[serde(default)]
    max_episode_steps: Option<usize>,
    #[serde(default)]
    variation: VariationRequest,
    #[serde(default)]
    image: Option<[usize; 2]>,
    #[serde(default)]
    views: Option<Vec<String>>,
    #[serde(default)]
    goal: Option<bool>,
    #[serde(default)]
    action_noise: Option<f64>,
    #[serde(default)]
    codec: Option<ImageCodec>,
    #[serde(default)]
    wrappers: Option<Vec<Choice>>,
    #[serde(default)]
    wrap_goal: Option<bool>,
}

/// Returns the arguments that continue the collection of a dataset, and their command line: those that are given, and for
/// the others those that the dataset records. `trust` says whether the dataset may choose any name.
///
/// # Errors
/// When there is no such dataset, it does not record its collection, or it names what only the user may name.
pub fn complete(given: &CollectArgs, trust: bool) -> Result<(CollectArgs, String)> {
    let location = home::target(&given.output, given.format.as_deref())?;
    if location.path().is_some_and(|path| !path.exists()) {
        home::find_dataset(&given.output)?;
    }
    swm_data::recover(&location)?;
    let manifest = match given.shard {
        Some(shard) => shard_manifest(&location, shard)?,
        None if location.path().is_some_and(swm_data::has_no_dataset) => None,
        None => swm_data::open(location.clone())?.manifest(),
    };
    let command = manifest.map_or(Ok(None), |manifest| arguments(&location, &manifest).map(Some))?;
    let Some(command) = command else {
        return Err(Error::config(location.to_string(), "it does not record how it was collected", NAME_ALL));
    };
    let recorded = parse(&location, &command)?;
    check_origin(given, &recorded, &Origin::file(location.to_string(), trust))?;
    Ok((merged(given, recorded), output::shorten(format!("swm collect {}", command.join(" ")))))
}

/// Parses a recorded command line as one that a user gives.
fn parse(location: &Location, command: &[String]) -> Result<CollectArgs> {
    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        arguments: CollectArgs,
    }
    let words = ["collect", "--output="].into_iter().chain(command.iter().map(String::as_str));
    Command::try_parse_from(words).map(|command| command.arguments).map_err(|error| {
        let problem = usage::on_one_line(&error);
        Error::config(location.to_string(), format!("what it records is no collection: {problem}"), NAME_ALL)
    })
}

/// Returns the arguments of `swm collect` for the collection that a manifest records, but for the output.
fn arguments(location: &Location, manifest: &Manifest) -> Result<Vec<String>> {
    let refused = |problem: String, fix: &str| Err(Error::config(location.to_string(), problem, fix));
    if manifest.kind != "collect" {
        return refused(format!("it was written by `{}`, not by `collect`", manifest.kind), NAME_ALL);
    }
    let missing: Vec<&str> =
        ["env", "policy", "episodes"].into_iter().filter(|name| manifest.config[name].is_null()).collect();
    if !missing.is_empty() {
        return refused(format!("it does not record the collection's {}", missing.join(", ")), NAME_ALL);
    }
    let recorded: Recorded = match serde_json::from_value(manifest.config.clone()) {
        Ok(recorded) => recorded,
        Err(error) => return refused(format!("what it records is no collection: {error}"), NAME_ALL),
    };
    if recorded.goal == Some(true) {
        let fix = "continue it in Python: World.collect with goal=True and mode='append'";
        return refused("it stores the frame of the goal, for which `swm collect` has no option".to_owned(), fix);
    }
    if let Some(choice) = recorded.wrappers.iter().flatten().find(|choice| choice.id.starts_with("python:")) {
        let problem = format!("it was collected with a wrapper or a setting of Python: {}", choice.id);
        return refused(problem, "continue it in Python: World.collect with mode='resume'");
    }
    Ok(recorded.into_arguments(manifest.seed))
}

impl Recorded {
    fn into_arguments(self, seed: u64) -> Vec<String> {
        let mut all = match self.policy {
            PolicyChoice::One(name) => vec![format!("--policy={name}")],
            PolicyChoice::Mixture(policies) => {
                policies.iter().map(|policy| format!("--policy={}:{}", policy.name, policy.weight)).collect()
            }
        };
        all.push(format!("--episodes={}", self.episodes));
        all.push(format!("--seed={seed}"));
        match self.image {
            Some([height, width]) => all.push(format!("--image={height}x{width}")),
            None => all.push("--no-pixels".to_owned()),
        }
        all.extend(self.views.into_iter().flatten().map(|view| format!("--view={view}")));
        all.extend(self.max_episode_steps.map(|steps| format!("--max-steps={steps}")));
        all.extend(self.action_noise.map(|noise| format!("--action-noise={noise}")));
        match self.codec {
            Some(ImageCodec::Jpeg { quality }) => all.extend(["--codec=jpeg".into(), format!("--quality={quality}")]),
            Some(ImageCodec::Png) => all.push("--codec=png".to_owned()),
            _ => {}
        }
        for Choice { id, settings } in self.wrappers.into_iter().flatten() {
            let settings = settings.as_object().into_iter().flatten();
            let settings: String = settings.map(|(name, value)| format!(",{name}={}", shown(value))).collect();
            all.push(format!("--wrapper={id}{settings}"));
        }
        if self.wrap_goal == Some(true) {
            all.push("--wrap-goal".to_owned());
        }
        all.extend(self.variation.variation.map(|keys| match &keys[..] {
            [] => "--variation=none".to_owned(),
            keys => format!("--variation={}", keys.join(",")),
        }));
        for (key, values) in self.variation.variation_values {
            let values: Vec<String> = values.iter().map(ToString::to_string).collect();
            all.push(format!("--pin={key}={}", values.join(",")));
        }
        all.extend(["--".to_owned(), self.env]);
        all
    }
}

/// Refuses what the dataset names and only the user may name. What the user gives replaces it.
fn check_origin(given: &CollectArgs, recorded: &CollectArgs, origin: &Origin) -> Result<()> {
    let env = recorded.env.as_deref().unwrap_or_default();
    if crate::env(env, &Origin::User).is_ok() && crate::env(env, origin).is_err() {
        let effect = "which imports a Python module, or has arguments other than numbers and plain words";
        let own = format!("swm collect '{env}' … with all its options");
        origin.check_user(&format!("the environment '{env}'"), effect, Some(&own))?;
    }
    for policy in recorded.policies.iter().filter(|policy| given.policies.is_empty() && policy.contains("://")) {
        origin.check_user(
            &format!("the policy '{policy}'"),
            "which opens a network connection",
            Some(&format!("--policy '{policy}'")),
        )?;
    }
    for wrapper in recorded.wrappers.wrappers.iter().filter(|_| given.wrappers.wrappers.is_empty()) {
        check_wrapper(origin, wrappers::read(wrapper)?.0)?;
    }
    Ok(())
}

/// Explains the error of a collection that is continued, if its policy is not found: it may be a class in Python.
pub fn unknown_policy(error: anyhow::Error) -> anyhow::Error {
    match error.downcast::<Error>() {
        Ok(Error::UnknownName { kind: "policy", given, .. }) => {
            let problem = "the dataset was collected with it, and no expert and no checkpoint has this name";
            let fix = if given.contains(",seed=") {
                "continue in Python, where policies have seeds (World.collect with mode='append')"
            } else {
                "name the path of its checkpoint with --policy, or continue in Python (World.collect with mode='append')"
            };
            Error::config(format!("policy '{given}'"), problem, fix).into()
        }
        Ok(other) => other.into(),
        Err(other) => other,
    }
}

/// Returns the given arguments, with the recorded ones where none are given.
fn merged(given: &CollectArgs, recorded: CollectArgs) -> CollectArgs {
    fn or<T: Clone>(given: &[T], recorded: Vec<T>) -> Vec<T> {
        if given.is_empty() { recorded } else { given.to_vec() }
    }
    let is_framed = given.image.is_some() || given.no_pixels;
    CollectArgs {
        env: recorded.env,
        output: given.output.clone(),
        policies: or(&given.policies, recorded.policies),
        action_noise: given.action_noise.or(recorded.action_noise),
        episodes: given.episodes.or(recorded.episodes),
        seed: given.seed.or(recorded.seed),
        envs: given.envs,
        image: if is_framed { given.image } else { recorded.image },
        no_pixels: if is_framed { given.no_pixels } else { recorded.no_pixels },
        views: or(&given.views, recorded.views),
        max_steps: given.max_steps.or(recorded.max_steps),
        format: given.format.clone(),
        shard: given.shard,
        strict_finite: given.strict_finite,
        mix_renderers: given.mix_renderers,
        codec: given.codec.or(&recorded.codec),
        resume: true,
        overwrite: false,
        wrappers: WrapperArgs {
            wrappers: or(&given.wrappers.wrappers, recorded.wrappers.wrappers),
            wrap_goal: given.wrappers.wrap_goal || recorded.wrappers.wrap_goal,
        },
        variation: VariationArgs {
            variation: given.variation.variation.clone().or(recorded.variation.variation),
            pin: or(&given.variation.pin, recorded.variation.pin),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cli::collect::Collection;
    use serde_json::{Value, json};
    use std::path::Path;

    #[test]
    fn arguments_of_a_manifest_are_those_of_the_collection() {
        let config = json!({
            "env": "swm/OGBCube-v0,env_type=double",
            "policy": [{"name": "expert", "weight": 2.5}, {"name": "random", "weight": 1.0}],
            "episodes": 7,
            "max_episode_steps": 12,
            "variation": {"variation": ["agent", "cube.color"], "variation_values": {"light.intensity": [0.1, -2.0]}},
            "image": [32, 48],
            "views": ["depth", "side_pixels"],
            "goal": false,
            "action_noise": 0.25,
            "codec": {"jpeg": {"quality": 80}},
            "wrappers": [{"id": "noise", "settings": {"std": 3}}, {"id": "cutout", "settings": {"color": [1, 2, 3]}}],
            "wrap_goal": true,
        });
        let location = Location::from(Path::new("cubes.lance"));
        let manifest = Manifest::new("collect", 9, config);
        let command = arguments(&location, &manifest).expect("a collection");
        let args = parse(&location, &command).expect("its arguments");
        let collection = Collection::of(&args, &location, 1).expect("a collection");
        assert_eq!(collection.env.id(), "swm/OGBCube-v0,env_type=double");
        assert_eq!((collection.config.seed, collection.config.episodes), (9, 7));
        assert_eq!(json!(collection.config.policy), manifest.config["policy"]);
        assert_eq!(json!(collection.config.variation), manifest.config["variation"]);
        assert_eq!(json!(collection.config.action_noise), manifest.config["action_noise"]);
        assert_eq!(json!(collection.codec), manifest.config["codec"]);
        assert_eq!(json!(collection.world.max_episode_steps), manifest.config["max_episode_steps"]);
        assert_eq!(collection.world.image, Some((32, 48)));
        assert_eq!(json!(args.views), manifest.config["views"]);
        assert_eq!(json!(args.wrappers.choices(&Origin::User).expect("wrappers")), manifest.config["wrappers"]);
        assert!(args.wrappers.wrap_goal && !args.no_pixels);

        let none = json!({"env": "swm/TwoRoom-v1", "policy": "expert", "episodes": 1, "variation": {"variation": []}});
        let command = arguments(&location, &Manifest::new("collect", 0, none)).expect("a collection");
        assert_eq!(
            command,
            ["--policy=expert", "--episodes=1", "--seed=0", "--no-pixels", "--variation=none", "--", "swm/TwoRoom-v1"]
        );
    }

    #[test]
    fn datasets_choose_no_code_files_and_connections() {
        let location = Location::from(Path::new("a.lance"));
        let file = Origin::file("a.lance", false);
        let args = |command: &[&str]| {
            let command: Vec<String> = command.iter().map(|&text| text.to_owned()).collect();
            parse(&location, &command).expect("arguments")
        };
        let (nothing, own) =
            (args(&["swm/TwoRoom-v1"]), ["--policy=s3://bucket/run", "--wrapper=chroma-key,media=a.png"]);
        for (command, part) in [
            (&["evil_mod:Cart-v0"][..], "swm collect 'evil_mod:Cart-v0' … with all its options"),
            (&["Ant-v5,xml_file=/etc/passwd"], "the environment 'Ant-v5,xml_file=/etc/passwd'"),
            (&[own[0], "swm/TwoRoom-v1"], "name it yourself (--policy 's3://bucket/run'), or trust the file (--trust"),
            (&[own[1], "swm/TwoRoom-v1"], "the wrapper 'chroma-key', which reads files"),
        ] {
            let recorded = args(command);
            let error = check_origin(&nothing, &recorded, &file).expect_err(part).to_string();
            assert!(error.contains(part), "{error}");
            check_origin(&nothing, &recorded, &Origin::User).expect("a trusted dataset");
        }
        let given = args(&[own[0], own[1], "swm/TwoRoom-v1"]);
        check_origin(&given, &given, &file).expect("names of the user");
    }

    #[test]
    fn policies_of_python_are_continued_there() {
        let unknown = |kind| anyhow::Error::from(Error::unknown(kind, "Mine", [], "hint"));
        let error = unknown_policy(unknown("policy")).to_string();
        assert!(
            error.starts_with("policy 'Mine': the dataset was collected with it") && error.contains("Python"),
            "{error}"
        );
        assert!(unknown_policy(unknown("wrapper")).to_string().starts_with("unknown wrapper 'Mine'"));
    }

    #[test]
    fn manifests_without_a_collection_say_what_to_give() {
        let refused = |kind: &str, config: Value| {
            arguments(&Location::from(Path::new("a.lance")), &Manifest::new(kind, 0, config))
                .expect_err(kind)
                .to_string()
        };
        let error = refused("collect", json!({"episodes": 3}));
        assert!(error.contains("does not record the collection's env, policy; give the environment"), "{error}");
        assert!(refused("record", json!({})).contains("it was written by `record`"));
        let all = json!({"env": "swm/TwoRoom-v1", "policy": "expert", "episodes": 1, "goal": true});
        assert!(refused("collect", all).contains("World.collect"));
        let odd = json!({"env": "swm/TwoRoom-v1", "policy": "expert", "episodes": 1, "image": "big"});
        assert!(refused("collect", odd).contains("no collection"));
    }
}
