//! What every visual wrapper must keep, checked on every row of the registry, and what each of them promises.

use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Stdio};
use swm_core::batch::{Batch, ColumnSpec, DType, Schema};
use swm_core::pool::{Reset, threads};
use swm_core::{Action, Env, EnvPool, FrameMut, Key, ResetOptions, Snapshot, VariationRequest};
use swm_envs::wrappers::{GoalPicture, Stack, View, VisualWrapper, WRAPPERS, parse};
use swm_envs::{ENVS, two_room};

/// Width and height of most pictures here: not square, so that mixed-up axes show.
const SIZE: [usize; 2] = [48, 40];

/// How a wrapper's pictures depend on seed and step.
#[derive(Clone, Copy, PartialEq)]
enum Draws {
    /// Not at all.
    Never,
    /// One look for an episode.
    Episode,
    /// Another look at every step of an episode.
    Step,
    /// At every step, the same in all episodes.
    Clock,
}

/// Settings of every wrapper: its defaults, the ends of its ranges, and everything that can be set at least once.
fn variants(folder: &Path) -> Vec<(String, Draws)> {
    use Draws::{Clock, Episode, Never, Step};
    let image = folder.join("image.png");
    let frames = folder.join("frames");
    std::fs::create_dir(&frames).expect("a folder");
    write_png(&image, 20, 30, &pattern(20, 30));
    for (i, level) in [10, 200, 60].into_iter().enumerate() {
        write_png(&frames.join(format!("{i}.png")), 5, 4, &[level; 60]);
    }
    let mut all: Vec<(String, Draws)> = [
        ("noise", Step),
        ("noise,std=0", Never),
        ("noise,std=255", Step),
        ("noise,std=sinusoidal/5/20/10", Step),
        ("noise,kind=salt-pepper,amount=0.3", Step),
        ("noise,kind=salt-pepper,amount=linear/1/0.1/9", Step),
        ("blur", Never),
        ("blur,kernel=1", Never),
        ("blur,kernel=99,sigma=100", Never),
        ("color-jitter", Episode),
        ("color-jitter,brightness=9,contrast=9,saturation=9,hue=0.5", Episode),
        ("color-jitter,brightness=0/0,contrast=10/10,saturation=0/0,hue=-0.5/-0.5", Never),
        ("grayscale", Never),
        ("random-shift,pad=12", Episode),
        ("random-shift,pad=1024,resample=step", Step),
        ("random-shift,pad=0", Never),
        ("cutout,num=3", Step),
        ("cutout,num=256,size=0/1,color=1/2/3", Step),
        ("occlusion,num_patches=2", Episode),
        ("occlusion,num_patches=256,size=0/1,color=9", Episode),
        ("occlusion,size=1", Never),
        ("moving-patch,num_patches=3", Step),
        ("moving-patch,num_patches=9,size=0/1,color=3/2/1,speed=1000", Step),
        ("random-conv", Episode),
        ("random-conv,kernel_size=15", Episode),
        ("resolution", Never),
        ("resolution,scale=0", Never),
        ("resolution,scale=1", Never),
    ]
    .map(|(text, draws)| (text.to_owned(), draws))
    .into();
    let chroma = |key: &str, media: &Path| format!("chroma-key,key_color={key},media={}", media.display());
    all.push((chroma("0/0/0", &image), Never));
    all.push((chroma("90/90/90/255/0/0,tolerance=442", &frames), Clock));
    all
}

fn make(text: &str) -> Box<dyn VisualWrapper> {
    parse(text).unwrap_or_else(|error| panic!("{text}: {error}"))
}

/// Colours of all kinds, with edges.
#[allow(clippy::cast_possible_truncation)]
fn pattern(width: usize, height: usize) -> Vec<u8> {
    let pixel = |x: usize, y: usize| match (x / 9 + y / 7) % 4 {
        0 => [(x * 11) as u8, (y * 7) as u8, 128],
        1 => [0; 3],
        2 => [255, (x * y) as u8, 10],
        _ => [40 + (x * 4) as u8; 3],
    };
    (0..height).flat_map(|y| (0..width).flat_map(move |x| pixel(x, y))).collect()
}

fn write_png(path: &Path, width: u32, height: u32, rgb: &[u8]) {
    let file = std::fs::File::create(path).expect("a file");
    let mut encoder = png::Encoder::new(file, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().expect("a header").write_image_data(rgb).expect("a picture");
}

/// What a wrapper makes of the pattern in the episode of a seed.
fn look(wrapper: &mut dyn VisualWrapper, [width, height]: [usize; 2], seed: u64, view: View) -> Vec<u8> {
    let mut rgb = pattern(width, height);
    wrapper.reset(Key::new(seed));
    wrapper.apply(&mut FrameMut::new(width, height, &mut rgb), view);
    rgb
}

#[test]
fn every_row_and_parameter_is_tried_and_described() {
    let folder = tempfile::tempdir().expect("a folder");
    let variants = variants(folder.path());
    let docs = include_str!("../../../../docs/wrappers.md");
    assert_eq!(WRAPPERS.rows.len(), 11);
    for entry in WRAPPERS.rows {
        let mine: Vec<&str> =
            variants.iter().map(|(text, _)| &text[..]).filter(|text| make(text).id() == entry.id).collect();
        assert!(!mine.is_empty(), "{} is tried", entry.id);
        assert!(!entry.summary.is_empty() && docs.contains(&format!("`{}`", entry.id)), "{} is in the docs", entry.id);
        let described = entry.describe();
        for parameter in entry.parameters {
            let name = parameter.name;
            assert!(mine.iter().any(|text| text.contains(&format!(",{name}="))), "{}: {name} is tried", entry.id);
            let row = format!(
                "| `{name}` | {} | {} | {} |",
                parameter.summary,
                parameter.default.map_or("must be given".to_owned(), |default| format!("`{default}`")),
                parameter.domain
            );
            assert!(docs.contains(&row), "docs/wrappers.md says, under {}:\n{row}", entry.id);
            assert_eq!(described["parameters"][name]["default"], parameter.default_value());
        }
    }
}

#[test]
fn pictures_follow_seed_and_step_only() {
    let folder = tempfile::tempdir().expect("a folder");
    for (text, draws) in variants(folder.path()) {
        let (mut wrapper, mut other) = (make(&text), make(&text));
        let at = View::Step;
        let first = look(&mut *wrapper, SIZE, 1, at(3));
        assert_eq!(first, look(&mut *wrapper, SIZE, 1, at(3)), "{text}: twice the same");
        // Neither what was drawn before, nor its size, nor who draws it, matters.
        look(&mut *other, [31, 7], 9, at(8));
        look(&mut *other, SIZE, 2, View::Goal);
        assert_eq!(first, look(&mut *other, SIZE, 1, at(3)), "{text}: the past matters");
        assert_eq!(first, look(&mut *other.fork(), SIZE, 1, at(3)), "{text}: a fork differs");
        let seeds: BTreeSet<Vec<u8>> = (1..9).map(|seed| look(&mut *wrapper, SIZE, seed, at(3))).collect();
        let steps: BTreeSet<Vec<u8>> = (0..8).map(|step| look(&mut *wrapper, SIZE, 1, at(step))).collect();
        let differ = [seeds.len() > 1, steps.len() > 1];
        let wanted = match draws {
            Draws::Never => [false, false],
            Draws::Episode => [true, false],
            Draws::Step => [true, true],
            Draws::Clock => [false, true],
        };
        assert_eq!(differ, wanted, "{text}: differs between [seeds, steps]");
    }
}

#[test]
fn pictures_of_any_size_will_do() {
    let folder = tempfile::tempdir().expect("a folder");
    let sizes = [[1, 1], [1, 9], [9, 1], [2, 2], [3, 2], [8, 17], [130, 3], [3, 130], [0, 0], [0, 4], [4, 0]];
    for (text, _) in variants(folder.path()) {
        let mut wrapper = make(&text);
        for size in sizes {
            for view in [View::Step(0), View::Step(u64::MAX), View::Goal] {
                assert_eq!(look(&mut *wrapper, size, 5, view).len(), 3 * size[0] * size[1], "{text}, {size:?}");
            }
        }
    }
}

/// A Two-Room whose world does not depend on the seed.
fn still() -> ResetOptions {
    let variation = VariationRequest { variation: Some(vec![]), ..VariationRequest::default() };
    ResetOptions { variation, ..ResetOptions::default() }
}

fn wrapped<S: AsRef<str>>(texts: &[S], goal: GoalPicture) -> Box<dyn Env> {
    Stack::parse(texts).expect("wrappers").wrap(two_room::ENTRY.env().expect("an environment"), goal)
}

fn picture(env: &mut dyn Env) -> Vec<u8> {
    let mut rgb = vec![0; 3 * SIZE[0] * SIZE[1]];
    env.render(FrameMut::new(SIZE[0], SIZE[1], &mut rgb)).expect("a picture");
    rgb
}

fn goal_picture(env: &mut dyn Env) -> Vec<u8> {
    let mut rgb = vec![0; 3 * SIZE[0] * SIZE[1]];
    env.render_goal(FrameMut::new(SIZE[0], SIZE[1], &mut rgb)).expect("a picture");
    rgb
}

fn step(env: &mut dyn Env) {
    env.step(Action::Continuous(&[0.5, -0.3])).expect("an action");
}

#[test]
fn a_restored_snapshot_continues_bit_for_bit() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut texts: Vec<String> = variants(folder.path()).into_iter().map(|(text, _)| text).collect();
    texts.retain(|text| !text.contains("=256"));
    for text in &texts {
        let stack = ["blur,kernel=3", text, "noise,std=linear/0/30/6"];
        let (mut env, mut other) = (wrapped(&stack, GoalPicture::Wrapped), wrapped(&stack, GoalPicture::Wrapped));
        env.reset(3, &still()).expect("a reset");
        other.reset(8, &still()).expect("a reset");
        (0..3).for_each(|_| step(&mut *env));
        step(&mut *other);
        let snapshot = env.snapshot();
        let follow = |env: &mut dyn Env| {
            let mut seen = vec![env.snapshot().0, picture(env), goal_picture(env)];
            for _ in 0..4 {
                step(env);
                seen.push(picture(env));
            }
            seen
        };
        let wanted = follow(&mut *env);
        for env in [&mut *env, &mut *other] {
            env.restore(&snapshot).expect("its own snapshot");
            assert!(follow(env) == wanted, "{text}: a restored environment goes on otherwise");
        }
        let bare = two_room::ENTRY.env().expect("an environment").snapshot().0;
        let cut = snapshot.0[..20].to_vec();
        let stranger = wrapped(&["grayscale"], GoalPicture::Clean).snapshot().0;
        for foreign in [bare, cut, stranger, vec![]] {
            assert!(env.restore(&Snapshot(foreign)).is_err(), "{text}: a foreign snapshot is refused");
        }
        assert!(
            two_room::ENTRY.env().expect("an environment").restore(&snapshot).is_err(),
            "{text}: a bare environment takes it"
        );
    }
}

#[test]
fn everything_but_the_picture_is_the_environments_own() {
    for entry in ENVS.rows {
        let stack = Stack::parse(&["noise", "occlusion"]).expect("wrappers");
        let (mut env, mut bare) = (
            stack.wrap(entry.env().expect("an environment"), GoalPicture::Clean),
            entry.env().expect("an environment"),
        );
        assert_eq!(env.spec().id, bare.spec().id);
        let schema = Schema::new(bare.spec().columns.clone()).expect("a schema");
        let [mut mine, mut other] = [Batch::zeros(&schema, 1), Batch::zeros(&schema, 1)];
        env.reset(4, &ResetOptions::default()).expect("a reset");
        bare.reset(4, &ResetOptions::default()).expect("a reset");
        for goal in 0..3 {
            let key = Key::new(goal);
            assert_eq!(env.sample_goal(key).is_ok(), bare.sample_goal(key).is_ok());
            env.observe(&mut mine.row_mut(0));
            bare.observe(&mut other.row_mut(0));
            (0..schema.columns().len()).for_each(|c| assert_eq!(mine.bytes(c), other.bytes(c), "{}", entry.id));
            assert_eq!(env.factors().iter().collect::<Vec<_>>(), bare.factors().iter().collect::<Vec<_>>());
            assert_eq!((env.is_success(), env.goal_distance()), (bare.is_success(), bare.goal_distance()));
            assert_eq!(goal_picture(&mut *env), goal_picture(&mut *bare), "{}: the goal is clean", entry.id);
            assert_ne!(picture(&mut *env), picture(&mut *bare), "{}: the picture is wrapped", entry.id);
        }
        let refused = ResetOptions { state: Some(vec![f64::NAN]), ..ResetOptions::default() };
        let before = picture(&mut *env);
        assert!(env.reset(5, &refused).is_err());
        assert_eq!(picture(&mut *env), before, "{}: a refused reset changes nothing", entry.id);
    }
    let none = Stack::parse::<&str>(&[]).expect("no wrapper");
    let mut env = none.wrap(two_room::ENTRY.env().expect("an environment"), GoalPicture::Wrapped);
    assert!(
        two_room::ENTRY.env().expect("an environment").restore(&env.snapshot()).is_ok(),
        "an empty stack is not there"
    );
    assert_eq!(picture(&mut *env), picture(&mut *two_room::ENTRY.env().expect("an environment")));
}

#[test]
fn a_wrapped_goal_looks_like_the_way_there() {
    let mut env = wrapped(&["color-jitter,hue=0.5", "noise"], GoalPicture::Wrapped);
    let mut clean = wrapped(&["color-jitter,hue=0.5"], GoalPicture::Wrapped);
    let at_goal = ResetOptions { state: Some(vec![60.0, 112.0]), goal_state: Some(vec![60.0, 112.0]), ..still() };
    for env in [&mut env, &mut clean] {
        env.reset(2, &at_goal).expect("a reset");
    }
    assert_eq!(picture(&mut *clean), goal_picture(&mut *clean), "what holds for the episode holds for the goal");
    assert_ne!(picture(&mut *env), goal_picture(&mut *env), "the goal has noise of its own");
    let goal = goal_picture(&mut *env);
    step(&mut *env);
    assert_eq!(goal, goal_picture(&mut *env), "the goal does not change on the way");
}

#[test]
fn a_dataset_row_begins_an_episode_of_the_last_seed() {
    let texts = ["noise", "occlusion,num_patches=3"];
    let (mut env, mut other) = (wrapped(&texts, GoalPicture::Clean), wrapped(&texts, GoalPicture::Clean));
    env.reset(6, &still()).expect("a reset");
    other.reset(6, &still()).expect("a reset");
    let begun = picture(&mut *env);
    (0..3).for_each(|_| step(&mut *env));
    let schema = Schema::new([ColumnSpec::new("state", DType::Float64, [2])]).expect("a schema");
    let mut row = Batch::zeros(&schema, 1);
    row.get_mut("state").expect("the state").copy_from_slice(&[60.0, 112.0]);
    for env in [&mut env, &mut other] {
        env.restore_from(row.row(0), row.row(0)).expect("a row");
        assert_eq!(picture(&mut **env), begun, "steps are counted from the row");
    }
    step(&mut *env);
    step(&mut *other);
    assert_eq!(picture(&mut *env), picture(&mut *other));
}

#[test]
fn the_order_and_the_place_in_the_stack_matter() {
    let seen = |texts: &[&str]| {
        let mut env = wrapped(texts, GoalPicture::Clean);
        env.reset(1, &still()).expect("a reset");
        picture(&mut *env)
    };
    assert_ne!(seen(&["noise,std=60", "blur"]), seen(&["blur", "noise,std=60"]));
    assert_ne!(seen(&["grayscale", "occlusion,color=255/0/0"]), seen(&["occlusion,color=255/0/0", "grayscale"]));
    // Two of a kind draw different things.
    let difference = |texts: &[&str]| {
        let (seen, clean) = (seen(texts), seen(&[]));
        seen.iter().zip(clean).filter(|(a, b)| **a != *b).count()
    };
    let one = difference(&["occlusion,color=99"]);
    assert!(difference(&["occlusion,color=99", "occlusion,color=99"]) > one, "the second patch lies elsewhere");
}

#[test]
fn threads_and_neighbours_do_not_matter() {
    let texts = ["color-jitter", "moving-patch", "noise", "random-shift,resample=step"];
    let play = |seeds: &[u64], workers: usize| -> Vec<Vec<u8>> {
        let stack = Stack::parse(&texts).expect("wrappers");
        let envs = seeds
            .iter()
            .map(|_| stack.wrap(two_room::ENTRY.env().expect("an environment"), GoalPicture::Wrapped))
            .collect();
        let image = Some((SIZE[1], SIZE[0]));
        let mut pool = EnvPool::new(envs, image, None, threads(workers).expect("threads")).expect("a pool");
        let resets: Vec<Reset> =
            seeds.iter().enumerate().map(|(slot, &seed)| Reset { slot, seed, options: still() }).collect();
        pool.reset(&resets).expect("a reset");
        let mut actions = Batch::zeros(&Schema::new([pool.spec().action_column()]).expect("a schema"), seeds.len());
        actions.get_mut::<f32>("action").expect("actions").fill(0.3);
        let mut seen = vec![vec![]; seeds.len()];
        for _ in 0..5 {
            for (slot, seen) in seen.iter_mut().enumerate() {
                for column in ["pixels", "goal"] {
                    let column = pool.infos().schema().index(column).expect("a column");
                    seen.extend_from_slice(pool.infos().row(slot).at::<u8>(column));
                }
            }
            pool.step(&actions, &vec![true; seeds.len()]).expect("a step");
        }
        seen
    };
    let wanted = play(&[0, 1, 2, 3, 4], 1);
    assert!(wanted == play(&[0, 1, 2, 3, 4], 4), "threads matter");
    assert!(wanted[3..4] == play(&[3], 2), "neighbours matter");
    assert!(wanted[0] != wanted[1], "every episode looks its own way");
}

#[test]
fn wrong_settings_are_refused_in_words() {
    let message = |text: &str| match parse(text) {
        Ok(_) => panic!("{text} is accepted"),
        Err(error) => {
            assert!(error.is_usage(), "{text}: {error}");
            error.to_string()
        }
    };
    let says = |text: &str, words: &[&str]| {
        let message = message(text);
        words.iter().for_each(|word| assert!(message.contains(word), "{text}: {message}"));
    };
    says("nose", &["wrapper", "'nose'", "noise", "swm wrappers"]);
    says("noise,sdt=8", &["'sdt'", "std", "takes kind, std, amount"]);
    says("chroma-key,color=1/2/3", &["'color'", "key_color"]);
    says("grayscale,keep=1", &["'keep'", "takes none"]);
    says("noise,8", &["'8'", "NAME=VALUE"]);
    says("noise,std=1,std=2", &["'std'", "twice"]);
    says("chroma-key,key_color=1/2/3", &["'media' is missing", "PNG"]);
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
        ("blur,kernel=0", "0", "a whole number from 1 to 99"),
        ("blur,kernel=2.5", "2.5", "a whole number from 1 to 99"),
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
        ("occlusion,num_patches=1e9", "1000000000", "a whole number"),
        ("moving-patch,speed=inf", "inf", "from 0 to 1000"),
        ("random-conv,kernel_size=16", "16", "from 1 to 15"),
        ("resolution,scale=2", "2", "from 0 to 1"),
        ("chroma-key,media=a.png,key_color=1/2/3/4", "1/2/3/4", "red/green/blue"),
        ("chroma-key,media=,key_color=1/2/3", "media", "a path"),
    ] {
        let name = text.split([',', '=']).nth(1).expect("a name");
        let name = if text.starts_with("chroma-key") && given.contains('/') { "key_color" } else { name };
        says(text, &[text.split(',').next().expect("a wrapper"), name, given, allowed]);
    }
    // The same by way of JSON.
    let json = |id: &str, settings: Value| {
        let settings = settings.as_object().expect("an object").clone();
        WRAPPERS.get(id).expect("a wrapper").make(&settings).err().map(|error| error.to_string())
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
fn missing_and_damaged_backgrounds_are_refused_in_words() {
    let folder = tempfile::tempdir().expect("a folder");
    let message = |name: &str| {
        let text = format!("chroma-key,key_color=0/0/0,media={}", folder.path().join(name).display());
        parse(&text).err().unwrap_or_else(|| panic!("{name} is accepted")).to_string()
    };
    std::fs::write(folder.path().join("damaged.png"), b"\x89PNG and nothing else").expect("a file");
    assert!(message("missing.png").contains("missing.png"));
    assert!(message("missing.mp4").contains("No such file"));
    assert!(message("damaged.png").contains("PNG file that opens"));
    assert!(message("").contains("no PNG file") || message("").contains("damaged.png"));
    if has_ffmpeg() {
        std::fs::write(folder.path().join("damaged.mp4"), b"no video").expect("a file");
        assert!(message("damaged.mp4").contains("ffmpeg can decode"), "{}", message("damaged.mp4"));
    }
}

fn has_ffmpeg() -> bool {
    Command::new("ffmpeg")
        .arg("-version")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|s| s.success())
}

#[test]
fn a_background_replaces_the_key_and_moves_with_the_episode() {
    let folder = tempfile::tempdir().expect("a folder");
    let levels = [250, 10, 130, 70];
    for (i, level) in levels.into_iter().enumerate() {
        write_png(&folder.path().join(format!("{i}.png")), 16, 16, &[level; 768]);
    }
    let mut backgrounds = vec![folder.path().to_owned()];
    if has_ffmpeg() {
        // One GIF whose frames are shown for different times, and a lossless video.
        for (name, filter) in
            [("a.gif", "setpts=N*(N+1)/TB/10,split[a][b];[a]palettegen[c];[b][c]paletteuse"), ("a.mkv", "null")]
        {
            let path = folder.path().join(name);
            let mut command = Command::new("ffmpeg");
            command.args(["-loglevel", "error", "-framerate", "7", "-i"]).arg(folder.path().join("%d.png"));
            command.args(["-vf", filter]);
            command.args(if name == "a.mkv" { &["-c:v", "png"][..] } else { &[] });
            let made = command.arg(&path).stdin(Stdio::null()).status().expect("ffmpeg runs").success();
            assert!(made, "ffmpeg makes {name}");
            backgrounds.push(path);
        }
    }
    for media in backgrounds {
        let text = format!("chroma-key,key_color=1/2/3/9/9/9,tolerance=2,media={}", media.display());
        let mut wrapper = make(&text);
        let mut seen = |step| {
            // The key itself, at distance 2, just beyond, the other key, something else.
            let mut rgb = [[1, 2, 3], [1, 4, 3], [2, 4, 3], [9, 9, 8], [200, 0, 0]].concat();
            wrapper.apply(&mut FrameMut::new(5, 1, &mut rgb), View::Step(step));
            assert_eq!((&rgb[6..9], &rgb[12..]), (&[2, 4, 3][..], &[200, 0, 0][..]), "{text}: other colours stay");
            assert!(rgb[..6].iter().chain(&rgb[9..12]).all(|&v| v == rgb[0]), "{text}: {rgb:?}");
            rgb[0]
        };
        for (step, level) in (0..).zip(levels.iter().cycle().take(10)) {
            assert!(seen(step).abs_diff(*level) <= 2, "{text}: step {step} shows {}, not {level}", seen(step));
        }
    }
}

/// What a wrapper makes of a grey picture at some steps, as numbers.
fn grey_looks(text: &str, level: u8, size: [usize; 2], steps: std::ops::Range<u64>) -> Vec<Vec<u8>> {
    let mut wrapper = make(text);
    wrapper.reset(Key::new(7));
    steps
        .map(|step| {
            let mut rgb = vec![level; 3 * size[0] * size[1]];
            wrapper.apply(&mut FrameMut::new(size[0], size[1], &mut rgb), View::Step(step));
            rgb
        })
        .collect()
}

fn mean(values: impl Iterator<Item = f64> + Clone) -> f64 {
    values.clone().sum::<f64>() / values.count() as f64
}

#[test]
fn gaussian_noise_has_the_moments_and_tails_of_a_gaussian() {
    for std in [1.0, 10.0, 30.0] {
        let looks = grey_looks(&format!("noise,std={std}"), 128, [224, 224], 0..7).concat();
        let n = looks.len() as f64;
        // Rounding down moves the mean by half a level and adds 1/12 to the variance.
        let noise = looks.iter().map(|&v| f64::from(v) - 127.5);
        let variance = mean(noise.clone().map(|v| v * v));
        assert!(mean(noise.clone()).abs() < 5.0 * std / n.sqrt(), "std {std}: the mean is {}", mean(noise));
        let wanted = std * std + 1.0 / 12.0;
        assert!((variance / wanted - 1.0).abs() < 0.01, "std {std}: the variance is {variance}, not {wanted}");
        if std > 5.0 {
            let fourth = mean(noise.clone().map(|v| v.powi(4))) / variance.powi(2);
            assert!((fourth - 3.0).abs() < 0.05, "std {std}: the kurtosis is {fourth}");
            for (z, wanted) in [(1.0, 0.317_31), (2.0, 0.045_50), (3.0, 0.002_700), (3.5, 0.000_465)] {
                // Levels reach half a level to both sides.
                let beyond = mean(noise.clone().map(|v| f64::from(u8::from(v.abs() > z * std))));
                let slack = 4.0 * (wanted / n).sqrt() + wanted * z * z * 0.5 / std;
                assert!((beyond - wanted).abs() < slack, "std {std}: {beyond} lie beyond {z} deviations, not {wanted}");
            }
        }
        // Neighbours, channels, rows and steps know nothing of each other.
        for lag in [1, 3, 4, 3 * 224, 3 * 224 * 224] {
            let pairs = looks.iter().zip(&looks[lag..]);
            let correlation = mean(pairs.map(|(&a, &b)| (f64::from(a) - 127.5) * (f64::from(b) - 127.5))) / variance;
            assert!(correlation.abs() < 5.0 / n.sqrt(), "std {std}: correlation {correlation} over {lag}");
        }
    }
    let white = grey_looks("noise,std=40", 255, [224, 224], 0..1).concat();
    let untouched = mean(white.iter().map(|&v| f64::from(u8::from(v == 255))));
    assert!((untouched - 0.5).abs() < 0.01, "half of the noise is clipped, not {untouched}");
    let schedule = grey_looks("noise,std=linear/0/20/2", 128, [64, 64], 0..4);
    let spread = |look: &[u8]| mean(look.iter().map(|&v| (f64::from(v) - 127.5).powi(2))).sqrt();
    assert!(schedule[0].iter().all(|&v| v == 128), "without noise nothing changes");
    for (look, std) in schedule.iter().zip([0.5, 10.0, 20.0, 20.0]) {
        assert!((spread(look) - std).abs() < 0.5, "{} is not {std}", spread(look));
    }
}

#[test]
fn salt_and_pepper_hit_whole_pixels_with_equal_chance() {
    for amount in [0.0, 0.05, 0.5, 1.0] {
        let looks = grey_looks(&format!("noise,kind=salt-pepper,amount={amount}"), 128, [201, 224], 0..3).concat();
        let pixels = looks.as_chunks::<3>().0;
        let share = |level: u8| mean(pixels.iter().map(|&pixel| f64::from(u8::from(pixel == [level; 3]))));
        let slack = 5.0 * (0.25 / pixels.len() as f64).sqrt();
        for (level, wanted) in [(0, amount / 2.0), (255, amount / 2.0), (128, 1.0 - amount)] {
            assert!((share(level) - wanted).abs() < slack, "amount {amount}: {} show {level}", share(level));
        }
        assert!((share(0) + share(255) + share(128) - 1.0).abs() < 1e-9, "pixels stay grey");
    }
}

#[test]
fn shifts_are_uniform_and_repeat_the_edge() {
    let mut wrapper = make("random-shift,pad=3,resample=step");
    let mut counts = [[0u32; 7]; 2];
    for step in 0..1400 {
        // Every pixel says where it comes from.
        let mut rgb: Vec<u8> = (0..20).flat_map(|y| (0..30).flat_map(move |x| [x, y, 0])).collect();
        wrapper.apply(&mut FrameMut::new(30, 20, &mut rgb), View::Step(step));
        let pixels = rgb.as_chunks::<3>().0;
        let offset = [0, 1].map(|axis| i32::from(pixels[10 * 30 + 15][axis]) - [15, 10][axis]);
        for (i, pixel) in (0..).zip(pixels) {
            let wanted = [(i % 30 + offset[0]).clamp(0, 29), (i / 30 + offset[1]).clamp(0, 19)];
            assert_eq!([0, 1].map(|axis| i32::from(pixel[axis])), wanted, "step {step}, pixel {i}");
        }
        for (counts, offset) in counts.iter_mut().zip(offset) {
            counts[usize::try_from(offset + 3).expect("at most pad")] += 1;
        }
    }
    for count in counts.as_flattened() {
        assert!((130..270).contains(count), "offsets are uniform: {counts:?}");
    }
}

/// The box around what is not 0 in a picture.
fn bounds(rgb: &[u8], width: usize) -> Option<[usize; 4]> {
    let at: Vec<[usize; 2]> = rgb
        .as_chunks::<3>()
        .0
        .iter()
        .enumerate()
        .filter(|(_, p)| **p != [0; 3])
        .map(|(i, _)| [i % width, i / width])
        .collect();
    let side = |axis: usize| Some((at.iter().map(|p| p[axis]).min()?, at.iter().map(|p| p[axis]).max()? + 1));
    let ((x0, x1), (y0, y1)) = (side(0)?, side(1)?);
    assert_eq!(at.len(), (x1 - x0) * (y1 - y0), "a full rectangle");
    Some([x0, y0, x1 - x0, y1 - y0])
}

#[test]
fn rectangles_have_the_asked_size_and_lie_anywhere_within() {
    for text in ["cutout,size=0.2/0.5,color=7", "occlusion,size=0.2/0.5,color=7", "moving-patch,size=0.2/0.5,color=7"] {
        let mut wrapper = make(text);
        let found: Vec<[usize; 4]> = (0..600)
            .map(|seed| {
                let mut rgb = vec![0; 3 * 100 * 60];
                wrapper.reset(Key::new(seed));
                wrapper.apply(&mut FrameMut::new(100, 60, &mut rgb), View::Step(seed % 50));
                bounds(&rgb, 100).expect("a rectangle")
            })
            .collect();
        for &[x, y, width, height] in &found {
            assert!((20..=50).contains(&width) && (12..=30).contains(&height), "{text}: {width} x {height}");
            assert!(x + width <= 100 && y + height <= 60, "{text}: it sticks out");
        }
        for (axis, side, low, high) in [(2, 100.0, 20.0, 50.0), (3, 60.0, 12.0, 30.0)] {
            let center = mean(found.iter().map(|f| f[axis - 2] as f64 + f[axis] as f64 / 2.0));
            assert!((center / side - 0.5).abs() < 0.04, "{text}: the middle lies at {center} of {side}");
            let size = mean(found.iter().map(|f| f[axis] as f64));
            assert!((size - (low + high) / 2.0).abs() < 0.05 * side, "{text}: the mean side is {size}");
        }
    }
}

#[test]
fn moving_patches_go_straight_and_stay_within() {
    let mut wrapper = make("moving-patch,size=0.2,color=7,speed=3");
    for seed in 0..20 {
        wrapper.reset(Key::new(seed));
        let places: Vec<[usize; 4]> = (0..200)
            .map(|step| {
                let mut rgb = vec![0; 3 * 100 * 60];
                wrapper.apply(&mut FrameMut::new(100, 60, &mut rgb), View::Step(step));
                bounds(&rgb, 100).expect("a rectangle")
            })
            .collect();
        assert!(places.iter().all(|place| place[2..] == [20, 12]), "the size stays");
        for pair in places.windows(2) {
            let away = [0, 1].map(|axis| pair[1][axis] as f64 - pair[0][axis] as f64);
            assert!(away[0].hypot(away[1]) < 3.0 + 1.5, "seed {seed}: from {:?} to {:?}", pair[0], pair[1]);
        }
        let moved: BTreeSet<_> = places.iter().collect();
        assert!(moved.len() > 50, "seed {seed}: it moves");
    }
}

#[test]
fn color_jitter_draws_within_its_ranges() {
    // On one grey, contrast, saturation and hue change nothing: what is left is the brightness.
    let levels = |text: &str| -> Vec<f64> {
        let mut wrapper = make(text);
        let level = |seed| {
            let mut rgb = vec![100; 12];
            wrapper.reset(Key::new(seed));
            wrapper.apply(&mut FrameMut::new(2, 2, &mut rgb), View::Step(0));
            assert!(rgb.iter().all(|v| *v == rgb[0]), "grey stays grey");
            f64::from(rgb[0])
        };
        (0..400).map(level).collect()
    };
    for (text, low, high) in [
        ("color-jitter,brightness=0.3", 70.0, 130.0),
        ("color-jitter,brightness=1.5/2", 150.0, 200.0),
        ("color-jitter,brightness=3", 0.0, 255.0),
    ] {
        let levels = levels(text);
        let (least, most) = (levels.iter().copied().fold(255.0, f64::min), levels.iter().copied().fold(0.0, f64::max));
        assert!(least >= low - 1.0 && most <= high, "{text}: from {least} to {most}");
        assert!(least < low + 0.1 * (high - low) && most > high - 0.1 * (high - low), "{text}: {least} to {most}");
    }
    // A turn by a third makes red green.
    let mut rgb = vec![255, 0, 0];
    let fixed = "color-jitter,brightness=1/1,contrast=1/1,saturation=1/1,hue=0.3333/0.3334";
    make(fixed).apply(&mut FrameMut::new(1, 1, &mut rgb), View::Step(0));
    assert!(rgb[1] == 255 && rgb[0] < 10 && rgb[2] < 10, "{rgb:?}");
}

#[test]
fn random_filters_have_weights_of_the_stated_variance() {
    for side in [1, 3, 5] {
        let mut wrapper = make(&format!("random-conv,kernel_size={side}"));
        let (n, deviation) = (21, 80.0 / f64::from(3 * side * side).sqrt());
        let mut seen = vec![];
        for seed in 0..400 {
            // One dim dot: what comes out are the weights, where they are positive.
            let mut rgb = vec![0; 3 * n * n];
            rgb[3 * (n * (n / 2) + n / 2)] = 80;
            wrapper.reset(Key::new(seed));
            wrapper.apply(&mut FrameMut::new(n, n, &mut rgb), View::Step(0));
            let radius = (side / 2) as usize;
            for y in n / 2 - radius..=n / 2 + radius {
                seen.extend_from_slice(&rgb[3 * (n * y + n / 2 - radius)..][..3 * side as usize]);
            }
            let touched = rgb.iter().filter(|v| **v > 0).count();
            assert!(touched <= seen.len() / (seed as usize + 1), "only the window is touched");
        }
        // Rounded down: on average half a level is lost of what is positive.
        let square = mean(seen.iter().filter(|v| **v > 0).map(|&v| (f64::from(v) + 0.5).powi(2)));
        let positive = mean(seen.iter().map(|&v| f64::from(u8::from(v > 0))));
        // A level of 0 hides the weights up to 1.
        let hidden = 0.4 / deviation;
        assert!((positive + hidden - 0.5).abs() < 0.03, "side {side}: {positive} of the weights are positive");
        let found = (square * positive / 0.5).sqrt();
        assert!((found / deviation - 1.0).abs() < 0.06, "side {side}: {found} is not {deviation}");
    }
}
