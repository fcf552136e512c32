//! Tests of the geometry of drawings: no text overlaps another or leaves the drawing.

use super::super::tests::{row, study};
use super::*;
use crate::plot::check_texts;
use swm_core::results::StudyRow;

/// Draws the first sheet of a study, and checks all texts of both layouts.
fn check(rows: Vec<StudyRow>, kinds: &[&str]) {
    let results = study(rows);
    let sheets = Sheet::all(&results);
    let drawn = draw(&sheets[0], 0).expect("drawing the figures");
    assert_eq!(drawn.iter().map(|figure| figure.name).collect::<Vec<_>>(), kinds);
    for figure in &drawn {
        assert_eq!(figure.drawing.inline.matches("<svg").count(), 2);
        check_texts(&figure.drawing.inline, 4);
        assert!(figure.drawing.png.starts_with(b"\x89PNG") && figure.drawing.svg.ends_with("</svg>\n"));
    }
}

/// Names of many lengths, scripts and reserved characters.
const NAMES: [&str; 6] = [
    "agent.color",
    "a condition whose name is much longer than the room that a figure has for the names of conditions, whatever its layout",
    "<b>&\"'",
    "光源の位置と背景の色が同時に変わる条件のとても長い名前",
    "WWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWWW",
    "\u{202e}reversed\u{1}\n",
];

fn shifted(policies: &[&str], conditions: &[(String, Vec<(&str, String)>)]) -> Vec<StudyRow> {
    let mut rows: Vec<StudyRow> = policies.iter().map(|policy| row("plain", policy, &[], 9)).collect();
    for (i, (name, variables)) in conditions.iter().enumerate() {
        let variables: Vec<(&str, &str)> = variables.iter().map(|(name, value)| (*name, value.as_str())).collect();
        rows.extend(policies.iter().enumerate().map(|(j, policy)| row(name, policy, &variables, (i * 7 + j * 3) % 11)));
    }
    rows
}

#[test]
fn texts_of_gaps_do_not_overlap() {
    let conditions: Vec<_> = NAMES.iter().map(|name| ((*name).to_owned(), vec![])).collect();
    for policies in [&["LeWM"][..], &["LeWM", "PLDM", "random"], &NAMES] {
        check(shifted(policies, &conditions), &["drop"]);
    }
}

#[test]
fn texts_of_lines_do_not_overlap() {
    for values in [&["0.5", "1", "2"][..], &["1", "2", "3", "4", "5", "100000"], &["-999999999", "0", "999999999"]] {
        let conditions: Vec<_> =
            values.iter().map(|x| (format!("{x} squares"), vec![(NAMES[1], (*x).to_owned())])).collect();
        check(shifted(&NAMES, &conditions), &["line"]);
    }
    let near =
        ["999999998.9999999", "999999999", "999999998.9999998"].map(|x| (x.to_owned(), vec![("x", x.to_owned())]));
    check(shifted(&["a"], &near), &["line"]);
}

#[test]
fn texts_of_wheels_do_not_overlap() {
    let hues = |step: usize, rings: &[&str]| -> Vec<_> {
        let each = rings.iter().flat_map(|ring| (0..360).step_by(step).map(move |hue| (hue, *ring)));
        each.map(|(hue, ring)| (format!("{hue} {ring}"), vec![("hue", hue.to_string()), ("s", ring.to_owned())]))
            .collect()
    };
    for rings in [&["0.1", "1"][..], &["0.1", "0.2", "0.3", "0.4", "0.5", "0.6", "0.7", "0.8", "0.9"], &["1"]] {
        for step in [5, 30, 90] {
            check(shifted(&NAMES, &hues(step, rings)), &["wheel"]);
        }
    }
}

#[test]
fn texts_of_maps_do_not_overlap() {
    let conditions: Vec<_> = (0..100).map(|i| (format!("{} {i}", NAMES[i % NAMES.len()]), vec![])).collect();
    let many: Vec<String> = (0..30).map(|i| format!("policy {i}")).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    for policies in [&NAMES[..], &many] {
        check(shifted(policies, &conditions), &["heat"]);
    }
}
