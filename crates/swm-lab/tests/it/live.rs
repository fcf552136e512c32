//! Live environments: requests, frames, back-pressure, malformed messages, and the end of a socket.

use super::{Received, TestLab};
use serde_json::{Value, json};
use swm_core::Key;
use swm_data::image;
use swm_lab::session::MOST_BYTES;
use tokio_tungstenite::tungstenite::protocol::Message;

#[test]
fn a_page_resets_pins_steps_and_drives() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    assert_eq!(live.reply("started")["seed"], 0);
    live.send(&json!({"type": "reset", "seed": 7, "pin": "agent.position=60,112;agent.speed=5", "variation": "none"}));
    let started = live.reply("started");
    assert_eq!((&started["seed"], &started["factors"]["agent.position"]), (&json!(7), &json!([60.0, 112.0])));
    let command = "swm frame swm/TwoRoom-v1 --seed 7 --image 32 --variation none --pin agent.position=60,112 agent.speed=5 \
                   --output frame.png";
    assert_eq!(started["command"], command);
    let python = "import gymnasium\nimport stable_worldmodel\n\nenv = gymnasium.make(\"swm/TwoRoom-v1\", image_shape=(32, 32))\n\
                  env.reset(seed=7, options={\"variation\": [], \"variation_values\": {\"agent.position\": [60, 112], \
                  \"agent.speed\": [5]}})\nframe = env.render()\n";
    assert_eq!(started["python"], python);
    let (first, jpeg) = live.frame(|header| header["step"] == 0.0);
    assert_eq!(first["state"], json!([60.0, 112.0]));
    assert_eq!(image::image_size(&jpeg).expect("a JPEG"), (32, 32));
    live.send(&json!({"type": "act", "action": [1.0, 0.0]}));
    live.send(&json!({"type": "step"}));
    let (moved, _) = live.frame(|header| header["step"] == 1.0);
    assert_eq!(moved["state"], json!([65.0, 112.0]), "a step of agent.speed pixels to the right");
    live.send(&json!({"type": "drive", "by": "expert"}));
    live.send(&json!({"type": "speed", "fps": 240.0}));
    live.send(&json!({"type": "play", "on": true}));
    let (last, _) = live.frame(|header| header["terminated"] == true || header["truncated"] == true);
    assert_eq!(
        (&last["success"], &last["playing"]),
        (&json!(true), &json!(false)),
        "the expert reaches the target: {last}"
    );
}

#[test]
fn requests_that_fail_say_why_and_leave_the_environment_as_it_is() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/PushT-v1");
    live.reply("started");
    for (request, part) in [
        (json!({"type": "reset", "seed": 1, "pin": "agent.colour=1,2,3"}), "did you mean agent.color"),
        (json!({"type": "reset", "seed": 1, "pin": "agent.color=300,0,0"}), "outside its space"),
        (json!({"type": "reset", "seed": u64::MAX}), "choose at most"),
        (json!({"type": "act", "action": [2.0, 0.0]}), "outside its space"),
        (json!({"type": "act", "action": [0.0]}), "outside its space"),
        (json!({"type": "reset", "seed": 1, "view": "depth"}), "cannot render depth"),
        (json!({"type": "reset", "seed": 1, "view": "top:deep"}), "camera modality"),
        (json!({"type": "reset", "seed": 1, "wrappers": "blurs"}), "did you mean blur"),
        (json!({"type": "reset", "seed": 1, "wrappers": "noise,std=$(ls)"}), "outside its space"),
        (
            json!({"type": "reset", "seed": 1, "wrappers": "chroma-key,media=/etc/passwd,key_color=1/2/3"}),
            "reads files",
        ),
        (json!({"type": "reset", "seed": 1, "wrappers": "blur;".repeat(65)}), "number of wrappers"),
        (json!({"type": "reset", "seed": 1, "view": "top", "wrappers": "blur"}), "wrappers do not change the view"),
        (json!({"type": "speed", "fps": 0.0}), "steps a second"),
        (json!({"type": "record", "dataset": "../escape"}), "is not one"),
        (json!({"type": "keep"}), "nothing is recorded"),
        (json!({"type": "exec", "command": "ls"}), "malformed message"),
    ] {
        live.send(&request);
        let message = live.reply("failed")["message"].as_str().unwrap_or_default().to_owned();
        assert!(message.contains(part), "{request}: {message}");
    }
    live.send(&json!({"type": "step"}));
    live.frame(|header| header["step"] == 1.0);
    assert!(!lab.home.path().join("datasets").exists(), "nothing was written");
}

#[test]
fn a_page_that_shows_nothing_misses_frames_and_gets_the_newest() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    live.reply("started");
    // Steps in order, then a request that fails: its reply comes after all of them.
    for _ in 0..30 {
        live.send(&json!({"type": "step"}));
    }
    live.send(&json!({"type": "keep"}));
    let mut frames = 0;
    loop {
        match live.receive() {
            Received::Frame(..) => frames += 1,
            Received::Reply(reply) if reply["type"] == "failed" => break,
            Received::Reply(_) => {}
            Received::Closed => panic!("the socket closed"),
        }
    }
    // One more was permitted by the first `reply`, which may have shown one.
    assert!(frames <= 3, "{frames} frames of 30");
    live.send(&json!({"type": "shown"}));
    live.frame(|header| header["step"] == 30.0);
}

#[test]
fn a_closed_socket_drops_its_environment() {
    let lab = TestLab::start();
    let mut all: Vec<_> = (0..4).map(|_| lab.live("swm/TwoRoom-v1")).collect();
    lab.wait_for_environments(4);
    all[0].socket.close(None).ok();
    all[0].socket.flush().ok();
    lab.wait_for_environments(3);
    // Browsers that are killed close nothing properly; one plays meanwhile.
    all[1].send(&json!({"type": "play", "on": true}));
    drop(all);
    lab.wait_for_environments(0);
}

#[test]
fn too_many_environments_are_refused() {
    let lab = TestLab::start();
    let all: Vec<_> = (0..32).map(|_| lab.live("swm/TwoRoom-v1")).collect();
    lab.wait_for_environments(32);
    let mut one_more = lab.live("swm/TwoRoom-v1");
    let message = one_more.reply("failed")["message"].to_string();
    assert!(message.contains("environments run already"), "{message}");
    drop(all);
}

#[test]
fn oversized_messages_close_the_socket_and_the_lab_lives() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    live.reply("started");
    let text = json!({"type": "record", "dataset": "x".repeat(MOST_BYTES)}).to_string();
    live.socket.send(Message::text(text)).ok();
    loop {
        if let Received::Closed = live.receive() {
            break;
        }
    }
    lab.wait_for_environments(0);
    assert_eq!(lab.get("api/envs").0, 200);
}

#[test]
fn malformed_messages_are_reported_in_one_short_line() {
    let lab = TestLab::start();
    let mut live = lab.live("swm/TwoRoom-v1");
    live.reply("started");
    live.send(&json!({"type": "step", (format!("\u{202e}evil\nWARN a forged line {}", "x".repeat(8000))): 1}));
    let message = live.reply("failed")["message"].as_str().unwrap_or_default().to_owned();
    assert!(message.contains("malformed message: unknown field `\\u{202e}evil WARN a forged line x"), "{message}");
    assert!(message.chars().count() < 250 && !message.contains(['\n', '\u{202e}']), "{message}");
}

/// A message made of a valid one by random changes, or of random bytes.
fn fuzzed(i: u64) -> Message {
    use rand::Rng as _;
    const VALID: [&str; 8] = [
        r#"{"type": "reset", "seed": 3, "pin": "agent.color=1,2,3", "variation": "all"}"#,
        r#"{"type": "reset", "seed": 3, "wrappers": "noise,std=8;blur,kernel=5", "wrap_goal": true}"#,
        r#"{"type": "reset", "seed": 3, "view": "top:depth", "wrappers": ""}"#,
        r#"{"type": "act", "action": [0.5, -0.5]}"#,
        r#"{"type": "speed", "fps": 30.0}"#,
        r#"{"type": "drive", "by": "expert"}"#,
        r#"{"type": "step"}"#,
        r#"{"type": "shown"}"#,
    ];
    let mut rng = Key::new(i).with("fuzz").rng();
    let mut bytes = VALID[rng.random_range(0..VALID.len())].as_bytes().to_vec();
    for _ in 0..rng.random_range(1..6) {
        let at = rng.random_range(0..bytes.len());
        match rng.random_range(0..4) {
            0 => bytes[at] = rng.random_range(32..127),
            1 => drop(bytes.remove(at)),
            2 => bytes.insert(at, b"{}[],:\"0-9eE\\u"[rng.random_range(0..14)]),
            _ => bytes.extend_from_within(at..),
        }
    }
    match rng.random_range(0..8) {
        0 => Message::binary(bytes),
        1 => Message::Ping(bytes[..bytes.len().min(100)].to_vec().into()),
        _ => Message::text(String::from_utf8_lossy(&bytes).into_owned()),
    }
}

#[test]
fn ten_thousand_fuzzed_messages_are_survived() {
    let lab = TestLab::start();
    for batch in 0..500 {
        let mut live = lab.live("swm/TwoRoom-v1");
        let sent = (0..20).take_while(|i| live.socket.send(fuzzed(20 * batch + i)).is_ok()).count();
        live.socket.send(Message::text(r#"{"type": "keep"}"#)).ok();
        // All of them are answered before this one.
        let answered = loop {
            match live.receive() {
                Received::Reply(reply) if reply["message"].to_string().contains("nothing is recorded") => break true,
                Received::Closed => break false,
                _ => {}
            }
        };
        assert!(answered && sent == 20, "the socket of batch {batch} closed");
    }
    lab.wait_for_environments(0);
    let mut live = lab.live("swm/TwoRoom-v1");
    live.reply("started");
    live.send(&json!({"type": "step"}));
    live.frame(|header: &Value| header["step"] == 1.0);
    // Malformed messages alone close a socket.
    let mut live = lab.live("swm/TwoRoom-v1");
    for _ in 0..100 {
        if live.socket.send(Message::text("no JSON")).is_err() {
            break;
        }
    }
    while !matches!(live.receive(), Received::Closed) {}
}
