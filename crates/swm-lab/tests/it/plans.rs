//! Plan sessions: searches, steps, the tree of steps, its bounds, and what is refused.

use super::planning::FRAMES;
use super::{Live, Received, TestLab};
use serde_json::{Value, json};
use swm_core::Key;
use swm_data::image;
use tokio_tungstenite::tungstenite::protocol::Message;

/// A page of plans of Two-Room with a small search.
fn planned(lab: &TestLab) -> Live {
    let mut live = lab.session("plan", "swm/TwoRoom-v1");
    live.reply("tree");
    live.send(&json!({"type": "reset", "seed": 7, "pin": "agent.position=60,112", "variation": "none"}));
    live.reply("tree");
    live.send(&settings(json!({})));
    let ready = live.reply("ready");
    let command = "swm eval simulator --env swm/TwoRoom-v1 --solver cem,elites=4,iterations=5,samples=16 --horizon 3 \
                   --receding-horizon 1 --action-block 2 --score terminal";
    assert_eq!((&ready["block"], &ready["command"]), (&json!(2), &json!(command)));
    live
}

fn settings(change: Value) -> Value {
    let mut planner = json!({
        "model": "simulator", "solver": "cem", "settings": {"samples": 16, "iterations": 5, "elites": 4}, "horizon": 3,
        "receding": 1, "block": 2, "score": "terminal", "warm": true,
    });
    for (key, value) in change.as_object().expect("settings") {
        planner[key] = value.clone();
    }
    json!({"type": "settings", "planner": planner})
}

#[test]
fn a_search_is_shown_with_its_candidates_and_what_they_lead_to() {
    let lab = TestLab::start();
    let listed = lab.json("api/planners?env=swm/TwoRoom-v1");
    assert_eq!(listed["models"][0]["name"], "simulator");
    let ids: Vec<&str> =
        listed["solvers"].as_array().expect("solvers").iter().filter_map(|row| row["id"].as_str()).collect();
    assert!(ids.contains(&"cem") && !ids.contains(&"categorical_cem"), "{ids:?}");
    let mut live = planned(&lab);
    live.send(&json!({"type": "decide"}));
    let planned = live.reply("planned");
    let plan = &planned["plan"];
    assert_eq!(["best", "mean", "elites", "spread"].map(|name| plan[name].as_array().map(Vec::len)), [Some(5); 4]);
    let best: Vec<f64> = plan["best"].as_array().expect("costs").iter().filter_map(Value::as_f64).collect();
    assert!(best[4] < best[0], "the search finds cheaper plans: {best:?}");
    assert_eq!((&plan["names"], &plan["iterations"][4]["index"]), (&json!(["agent"]), &json!(4)));
    assert_eq!((&plan["iterations"][0]["elites"], &plan["iterations"][0]["samples"]), (&json!(4), &json!(16)));
    let paths = plan["paths"].as_array().expect("paths");
    // All candidates of five iterations, from the agent's place over six steps.
    assert_eq!(paths.len(), 5 * 16);
    let start = json!([(60.0_f64 / 224.0 * 1e4).round() / 1e4, 0.5]);
    for path in paths {
        let line = path["lines"][0].as_array().expect("a line");
        let near = |i: usize| (line[0][i].as_f64().unwrap_or_default() - start[i].as_f64().unwrap_or_default()).abs();
        assert!(line.len() == 7 && near(0) < 1e-4 && near(1) < 1e-4, "{path}");
    }
    assert_eq!(plan["ends"].as_array().map(Vec::len), Some(4 + 4));
    // The present plan is executed, then the next one is searched.
    live.send(&json!({"type": "decide"}));
    assert_eq!([live.reply("node")["node"]["step"].clone(), live.reply("node")["node"]["step"].clone()], [1, 2]);
    assert_eq!(live.reply("planned")["node"], json!(planned["node"].as_u64().expect("a step") + 2));
    let (header, jpeg) = live.frame(|header| header["step"] == 2 && header["playing"] == false);
    assert_eq!((&header["left"], image::image_size(&jpeg).expect("a JPEG")), (&json!(2), (32, 32)));
}

#[test]
fn any_step_can_be_gone_back_to_and_continued_with_something_else() {
    let lab = TestLab::start();
    let mut live = planned(&lab);
    for _ in 0..4 {
        live.send(&json!({"type": "step"}));
    }
    let nodes: Vec<Value> = (0..4).map(|_| live.reply("node")["node"].clone()).collect();
    let second = nodes[1]["id"].clone();
    live.send(&json!({"type": "go", "node": second}));
    assert_eq!(live.reply("planned")["node"], nodes[1]["id"].clone(), "a plan was made there");
    let (header, _) = live.frame(|header| header["node"] == second);
    assert_eq!((&header["step"], &header["distance"]), (&json!(2), &nodes[1]["distance"]));
    live.send(&json!({"type": "act", "action": [0.0, 1.0]}));
    let by_hand = live.reply("node")["node"].clone();
    assert_eq!((&by_hand["parent"], &by_hand["branch"], &by_hand["step"]), (&second, &json!(1), &json!(3)));
    assert_eq!(by_hand["change"], "action 0.000 1.000");
    let y = |node: &Value| node["at"][0][1].as_f64().unwrap_or_default();
    assert!((y(&by_hand) - y(&nodes[1]) - 5.0 / 224.0).abs() < 1e-3, "5 pixels down");
    // The same step again gives the same plan and so the same branch.
    let mut again = vec![];
    for _ in 0..2 {
        live.send(&json!({"type": "go", "node": second}));
        live.send(&json!({"type": "step"}));
        again.push(live.reply("node")["node"].clone());
    }
    assert_eq!((&again[0]["at"], &again[0]["branch"], &again[1]["branch"]), (&again[1]["at"], &json!(2), &json!(3)));
    live.send(&json!({"type": "change", "factor": "agent.speed", "value": [10.0]}));
    let changed = live.reply("node")["node"].clone();
    assert_eq!((&changed["change"], &changed["step"]), (&json!("agent.speed = 10"), &json!(3)));
    assert_eq!(changed["at"], again[1]["at"], "the state stays");
    live.send(&json!({"type": "act", "action": [0.0, 1.0]}));
    let faster = live.reply("node")["node"].clone();
    assert!((y(&faster) - y(&changed) - 10.0 / 224.0).abs() < 1e-3, "10 pixels down");
    live.send(&json!({"type": "peek", "node": second}));
    assert_eq!(live.reply("peeked")["node"], second);
    live.send(&json!({"type": "forget"}));
    let tree = live.reply("tree");
    // The first two steps, the step of the third branch, the changed factor and the step after it, from the start.
    assert_eq!((tree["nodes"].as_array().map(Vec::len), &tree["present"]), (Some(6), &faster["id"]));
}

#[test]
fn requests_of_plans_that_fail_say_why() {
    let lab = TestLab::start();
    let mut live = planned(&lab);
    for (request, part) in [
        (settings(json!({"model": "../secret"})), "unknown model"),
        (settings(json!({"model": "/etc/passwd"})), "unknown model"),
        (settings(json!({"solver": "module:Solver"})), "unknown solver"),
        (settings(json!({"settings": {"samples": 1_000_000_000}})), "choose at most"),
        (settings(json!({"settings": {"samples": 16, "elites": 100}})), "elites"),
        (settings(json!({"horizon": 5000})), "choose a horizon"),
        (settings(json!({"solver": "gd", "settings": {}})), "gradient"),
        (json!({"type": "go", "node": 12345}), "the tree has no step"),
        (json!({"type": "peek", "node": 12345}), "the tree has no step"),
        (json!({"type": "act", "action": [0.0]}), "outside its space"),
        (json!({"type": "change", "factor": "agent.colour", "value": [1.0, 2.0, 3.0]}), "agent.color"),
        (json!({"type": "change", "factor": "agent.speed", "value": [1e9]}), "outside its space"),
        (json!({"type": "decode", "dataset": {"folder": 0, "name": "../secret"}}), "unknown entry"),
        (json!({"type": "decode", "dataset": {"folder": 9, "name": "rooms.lance"}}), "unknown entry"),
        (json!({"type": "decode", "dataset": "/etc/passwd"}), "malformed message"),
        (json!({"type": "speed", "fps": 1e9}), "steps a second"),
        (json!({"type": "reset", "seed": u64::MAX}), "choose at most"),
        (json!({"type": "train"}), "malformed message"),
    ] {
        live.send(&request);
        let message = live.reply("failed")["message"].as_str().unwrap_or_default().to_owned();
        assert!(message.contains(part), "{request}: {message}");
    }
    live.send(&json!({"type": "step"}));
    assert_eq!(live.reply("node")["node"]["step"], 1, "the session lives");
    let mut unplanned = lab.session("plan", "swm/TwoRoom-v1");
    unplanned.send(&json!({"type": "decide"}));
    assert!(unplanned.reply("failed")["message"].to_string().contains("choose a model and a solver"));
    for env in ["module:Env-v0", "CartPole-v1", ""] {
        for route in ["plan", "planners"] {
            assert_eq!(lab.get(&format!("api/{route}?env={env}")).0, 400, "{route} {env}");
        }
    }
}

#[test]
fn refused_settings_leave_the_planner_in_use() {
    let lab = TestLab::start();
    let mut live = planned(&lab);
    live.send(&settings(json!({"model": FRAMES})));
    live.reply("ready");
    live.send(&json!({"type": "decide"}));
    live.reply("planned");
    live.send(&settings(json!({"settings": {"samples": 16, "elites": 100}})));
    assert!(live.reply("failed")["message"].to_string().contains("elites"));
    for request in [json!({"type": "decide"}), json!({"type": "reset", "seed": 3}), json!({"type": "decide"})] {
        live.send(&request);
        live.reply(if request["type"] == "decide" { "planned" } else { "tree" });
    }
}

#[test]
fn a_long_search_ends_when_the_page_asks_or_leaves() {
    let lab = TestLab::start();
    let mut live = planned(&lab);
    let long = json!({"settings": {"samples": 100, "iterations": 10_000, "elites": 4}, "horizon": 100});
    live.send(&settings(long.clone()));
    live.reply("ready");
    live.send(&json!({"type": "decide"}));
    live.reply("searching");
    live.send(&json!({"type": "enough"}));
    let plan = live.reply("planned");
    assert!(plan["plan"]["best"].as_array().is_some_and(|best| best.len() < 10_000));
    live.send(&json!({"type": "reset", "seed": 1}));
    live.reply("tree");
    live.send(&json!({"type": "decide"}));
    live.reply("searching");
    drop(live);
    lab.wait_for_environments(0);
}

#[test]
fn too_many_pages_of_plans_are_refused() {
    let lab = TestLab::start();
    let all: Vec<_> = (0..8).map(|_| lab.session("plan", "swm/TwoRoom-v1")).collect();
    lab.wait_for_environments(8);
    let message = lab.session("plan", "swm/TwoRoom-v1").reply("failed")["message"].to_string();
    assert!(message.contains("pages of plans are open"), "{message}");
    drop(all);
}

/// A message of a plan session made of a valid one by random changes.
fn fuzzed(i: u64) -> Message {
    use rand::Rng as _;
    let mut rng = Key::new(i).with("fuzz of plans").rng();
    let valid = [
        settings(json!({"horizon": 1, "settings": {"samples": 4, "iterations": 1, "elites": 2}})).to_string(),
        r#"{"type": "reset", "seed": 3, "pin": "agent.color=1,2,3", "variation": "all"}"#.to_owned(),
        r#"{"type": "act", "action": [0.5, -0.5]}"#.to_owned(),
        r#"{"type": "change", "factor": "agent.speed", "value": [5.0]}"#.to_owned(),
        r#"{"type": "go", "node": 1}"#.to_owned(),
        r#"{"type": "peek", "node": 1}"#.to_owned(),
        r#"{"type": "decide"}"#.to_owned(),
        r#"{"type": "step"}"#.to_owned(),
        r#"{"type": "play", "on": true}"#.to_owned(),
        r#"{"type": "forget"}"#.to_owned(),
        r#"{"type": "enough"}"#.to_owned(),
    ];
    let mut bytes = valid[rng.random_range(0..valid.len())].clone().into_bytes();
    for _ in 0..rng.random_range(0..5) {
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
        _ => Message::text(String::from_utf8_lossy(&bytes).into_owned()),
    }
}

#[test]
fn ten_thousand_fuzzed_messages_of_plans_are_survived() {
    let lab = TestLab::start();
    for batch in 0..500 {
        let mut live = lab.session("plan", "swm/TwoRoom-v1");
        let sent = (0..20).take_while(|i| live.socket.send(fuzzed(20 * batch + i)).is_ok()).count();
        live.socket.send(Message::text(r#"{"type": "peek", "node": 99999999}"#)).ok();
        let answered = loop {
            match live.receive() {
                Received::Reply(reply) if reply["message"].to_string().contains("no step 99999999") => break true,
                Received::Closed => break false,
                _ => {}
            }
        };
        assert!(answered && sent == 20, "the socket of batch {batch} closed");
    }
    lab.wait_for_environments(0);
    let mut live = planned(&lab);
    live.send(&json!({"type": "step"}));
    live.reply("node");
}
