//! The page of an autopsy: the verdict, what each ingredient contributes, every arm, and the smallest repair of every failure.

use crate::charts;
use crate::limits;
use crate::page::{Head, document};
use crate::text::{escape, percent, points, shorten};
use base64::Engine as _;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use swm_core::results::{Autopsy, Estimate, ProbeScores, Repair, letters};
use swm_core::{Error, Result, files};

/// The style of what only this page has.
const STYLE: &str = ".strip img { display: block; width: 100%; height: auto; image-rendering: pixelated; border-radius: 6px; }\n\
                     .strip { margin: 0.6rem 0 1.4rem; }\n";
/// The most failures with a row.
const REPAIRS: usize = 200;
/// The most elements of a state with a row.
const ELEMENTS: usize = 200;
/// The largest size of all frame strips together, in bytes.
const STRIP_BYTES: usize = 3 << 20;

/// What the page shows.
#[derive(Clone, Debug)]
pub struct AutopsyPage {
    /// The title.
    pub title: String,
    /// The environment.
    pub env: String,
    /// The outcome.
    pub found: Autopsy,
    /// What probes read from the latents of the model, if they were fitted.
    pub probes: Option<ProbeScores>,
    /// Frame strips of repaired starts.
    pub strips: Vec<FrameStrip>,
    /// The command that runs the autopsy again.
    pub command: String,
}

/// The frames of a repaired start, side by side, and the goal.
#[derive(Clone, Debug)]
pub struct FrameStrip {
    /// The index of the start.
    pub start: usize,
    /// The letters of the ingredients.
    pub set: String,
    /// The image, a PNG file.
    pub png: Vec<u8>,
}

/// Writes the page to `out_dir/index.html` and returns its path. Equal autopsies give equal bytes.
///
/// # Errors
/// When drawing a chart fails, which is a bug, or the page cannot be written.
pub fn write_autopsy(page: &AutopsyPage, out_dir: &Path) -> Result<PathBuf> {
    std::fs::create_dir_all(out_dir).map_err(|source| Error::io(out_dir, "creating the folder of the page", source))?;
    let path = out_dir.join("index.html");
    files::write(&path, render(page)?.as_bytes())?;
    Ok(path)
}

fn render(page: &AutopsyPage) -> Result<String> {
    let AutopsyPage { title, env, found, probes: scores, strips, command } = page;
    let title = shorten(title, limits::TEXT_CHARS);
    let lede = format!(
        "{} · {} starts, {} failures · {} planning seeds for each arm",
        escape(&shorten(env, limits::TEXT_CHARS)),
        found.starts,
        found.repairs.len(),
        found.planning_seeds
    );
    document(&Head { title: &title, lede: &lede, style: STYLE }, |html| {
        let p = found.selection;
        let _ = write!(
            html,
            "<section>\n<p class=\"answer\">{}.</p>\n<p>The unchanged policy solves {} of {} starts [{:.0}, {:.0}] in the run \
             that selects the failures. Every arm then plays all starts again, with other planning seeds.</p>\n\
             <p>The command that runs the autopsy again, or continues it:</p>\n<pre>{}</pre>\n</section>\n",
            escape(&capital(&found.finding.to_string())),
            percent(p.rate),
            p.n,
            100.0 * p.low,
            100.0 * p.high,
            escape(&shorten(command, limits::STUDY_TEXT_CHARS))
        );
        contributions(html, found)?;
        arms(html, found)?;
        if let Some(scores) = scores {
            probes(html, scores);
        }
        repairs(html, found, strips);
        Ok(())
    })
}

/// A sentence with a capital letter.
fn capital(sentence: &str) -> String {
    let mut chars = sentence.chars();
    chars.next().map_or(String::new(), |first| first.to_uppercase().chain(chars).collect())
}

fn figure(html: &mut String, heading: &str, caption: &str, chart: &str) {
    let _ = write!(
        html,
        "<figure class=\"plot\">\n<h3>{heading}</h3>\n{chart}<figcaption>{caption}</figcaption>\n</figure>\n"
    );
}

/// A rate with its interval, in percentage points.
fn shares(rate: Option<&Estimate>) -> String {
    rate.map_or("–".to_owned(), |Estimate { value, low, high }| {
        format!("<b>{}</b> [{}, {}]", points(*value), points(*low), points(*high))
    })
}

/// Opens a table with these columns, the first of which names rows.
fn open_table(html: &mut String, columns: &[&str]) {
    html.push_str("<div class=\"wide stack\">\n<table>\n<thead>\n<tr>");
    for (i, column) in columns.iter().enumerate() {
        let class = if i == 0 { "" } else { " class=\"n\"" };
        let _ = write!(html, "<th scope=\"col\"{class}>{column}</th>");
    }
    html.push_str("</tr>\n</thead>\n<tbody>\n");
}

/// What every ingredient contributes.
fn contributions(html: &mut String, found: &Autopsy) -> Result<()> {
    html.push_str("<section>\n<h2>Contributions</h2>\n");
    if let Some(chart) = charts::autopsy::contributions(found)? {
        let caption = "The Shapley value of each ingredient: the success on the failures that it adds, as the mean over all orders \
                       in which ingredients can be added, in percentage points. Contributions sum to what all ingredients \
                       together recover. Whiskers are 95 % intervals of a bootstrap over starts; a filled dot is told apart \
                       from zero.";
        figure(html, "What each ingredient recovers", caption, &chart);
    }
    open_table(html, &["Ingredient", "Recovers", "Alone", "Ranks first"]);
    for contribution in &found.contributions {
        let _ = writeln!(
            html,
            "<tr><th scope=\"row\">{} {}</th><td class=\"n\" data-label=\"Recovers\">{}</td>\
             <td class=\"n\" data-label=\"Alone\">{}</td><td class=\"n\" data-label=\"Ranks first\">{}</td></tr>",
            contribution.ingredient.letter(),
            contribution.ingredient.summary(),
            shares(found.on_failures(&contribution.recovered)),
            shares(found.on_failures(&contribution.alone)),
            found.on_failures(contribution.first).map_or("–".to_owned(), percent)
        );
    }
    html.push_str("</tbody>\n</table>\n</div>\n</section>\n");
    Ok(())
}

/// The success of every arm.
fn arms(html: &mut String, found: &Autopsy) -> Result<()> {
    html.push_str("<section>\n<h2>Arms</h2>\n");
    let caption = "The success rate of the policy with each set of ingredients, over all starts and planning seeds, with 95 % \
                   bootstrap intervals over starts.";
    figure(html, "Success of every arm", caption, &charts::autopsy::arms(found)?);
    open_table(html, &["Arm", "Success, %", "Recovered of failures", "Harmed of solved starts"]);
    for arm in &found.arms {
        let Estimate { value, low, high } = arm.success;
        let is_changed = !arm.ingredients.is_empty();
        let _ = writeln!(
            html,
            "<tr><th scope=\"row\">{}</th><td class=\"n\" data-label=\"Success, %\"><b>{:.0}</b> [{:.0}, {:.0}]</td>\
             <td class=\"n\" data-label=\"Recovered of failures\">{}</td>\
             <td class=\"n\" data-label=\"Harmed of solved starts\">{}</td></tr>",
            if is_changed { letters(&arm.ingredients) } else { "unchanged".to_owned() },
            100.0 * value,
            100.0 * low,
            100.0 * high,
            shares(found.on_failures(&arm.recovered).filter(|_| is_changed)),
            shares(found.on_solved(&arm.harmed).filter(|_| is_changed))
        );
    }
    html.push_str("</tbody>\n</table>\n</div>\n</section>\n");
    Ok(())
}

/// What probes read from the latents.
fn probes(html: &mut String, scores: &ProbeScores) {
    let ProbeScores { dataset, trivial, elements } = scores;
    let _ = write!(
        html,
        "<section>\n<h2>What the latents hold</h2>\n<p>The share of the variance (R²) of each element of the state that probes \
         read from the latents of single observations: a linear map, and a network with two hidden layers. Both are fitted on \
         training episodes of {} and scored on validation episodes. C plans by the one with the higher mean.</p>\n\
         <p class=\"note\">{}</p>\n",
        escape(&shorten(dataset, limits::TEXT_CHARS)),
        escape(&scores.note())
    );
    let from = trivial.as_ref().map(|column| format!("R², {} alone", escape(&shorten(column, limits::TEXT_CHARS))));
    let columns: Vec<&str> = ["Element", "R², linear", "R², network"].into_iter().chain(from.as_deref()).collect();
    open_table(html, &columns);
    for score in elements.iter().take(ELEMENTS) {
        let _ = write!(html, "<tr><th scope=\"row\">{}</th>", escape(&shorten(&score.element, limits::TEXT_CHARS)));
        for (column, value) in columns[1..].iter().zip([score.linear, score.network, score.trivial]) {
            let value = value.map_or("–".to_owned(), |value| format!("{value:.3}"));
            let _ = write!(html, "<td class=\"n\" data-label=\"{column}\">{value}</td>");
        }
        html.push_str("</tr>\n");
    }
    html.push_str("</tbody>\n</table>\n</div>\n");
    if elements.len() > ELEMENTS {
        let more = elements.len() - ELEMENTS;
        let _ = writeln!(html, "<p class=\"note\">{more} more elements are in <code>autopsy.json</code>.</p>");
    }
    html.push_str("</section>\n");
}

/// The smallest repair of every failure, with its frame strip.
fn repairs(html: &mut String, found: &Autopsy, strips: &[FrameStrip]) {
    if found.repairs.is_empty() {
        return;
    }
    html.push_str(
        "<section>\n<h2>Smallest repairs</h2>\n<p class=\"note\">For each failure, the smallest sets of ingredients with which \
         most planning seeds solve it. A strip shows the start, the frames of an episode that solves it at equal distances in \
         time, and the goal.</p>\n",
    );
    let mut left = STRIP_BYTES;
    for repair in found.repairs.iter().take(REPAIRS) {
        let Repair { start, row, sets } = repair;
        let at = row.map_or(String::new(), |[episode, step]| format!(" (episode {episode}, step {step})"));
        let _ = writeln!(html, "<p><b>Start {start}</b>{at}: {}</p>", sentence(sets.iter().map(|set| letters(set))));
        for strip in strips.iter().filter(|strip| strip.start == *start) {
            if strip.png.len() > left {
                continue;
            }
            left -= strip.png.len();
            let image = base64::engine::general_purpose::STANDARD.encode(&strip.png);
            let set = escape(&strip.set);
            let _ = writeln!(
                html,
                "<figure class=\"strip\"><img alt=\"Frames of start {start} with {set}, and the goal\" \
                 src=\"data:image/png;base64,{image}\"/><figcaption>With {set}.</figcaption></figure>"
            );
        }
    }
    if found.repairs.len() > REPAIRS {
        let more = found.repairs.len() - REPAIRS;
        let _ = writeln!(html, "<p class=\"note\">{more} more failures are in <code>autopsy.json</code>.</p>");
    }
    html.push_str("</section>\n");
}

/// The repairs of a start in words.
fn sentence(sets: impl Iterator<Item = String>) -> String {
    let sets: Vec<String> = sets.collect();
    match &sets[..] {
        [] => "no arm solves it.".to_owned(),
        [set] if set == &letters(&[]) => "the unchanged policy solves it with other planning seeds.".to_owned(),
        _ => format!("{}.", sets.join(" or ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::{Arm, Contribution, Finding, Ingredient, ProbeScore, Proportion};

    fn probes() -> ProbeScores {
        let score = |element: &str, linear| ProbeScore {
            element: element.to_owned(),
            linear,
            network: Some(0.987),
            trivial: Some(0.25),
        };
        ProbeScores {
            dataset: "rooms".to_owned(),
            trivial: Some("pos_agent".to_owned()),
            elements: vec![score("state[0]", Some(0.912)), score("sin state[4]", None)],
        }
    }

    fn autopsy() -> Autopsy {
        let some = Estimate { value: 0.5, low: 0.25, high: 0.75 };
        let [dynamics, distance] = [Ingredient::Dynamics, Ingredient::Distance];
        let arm = |ingredients: &[Ingredient]| Arm {
            ingredients: ingredients.to_vec(),
            success: some,
            recovered: some,
            harmed: Estimate::default(),
        };
        let contribution = |ingredient| Contribution { ingredient, recovered: some, alone: some, first: 0.97 };
        Autopsy {
            starts: 30,
            selection: Proportion::wilson(12, 30),
            planning_seeds: 3,
            contributions: vec![contribution(dynamics), contribution(distance)],
            arms: vec![arm(&[]), arm(&[dynamics]), arm(&[dynamics, distance])],
            finding: Finding::Culprit(dynamics),
            repairs: vec![
                Repair { start: 4, row: Some([7, 25]), sets: vec![vec![dynamics], vec![dynamics, distance]] },
                Repair { start: 6, row: None, sets: vec![vec![]] },
                Repair { start: 9, row: None, sets: vec![] },
            ],
        }
    }

    #[test]
    fn rates_of_no_starts_are_not_shown() {
        let found = autopsy();
        let harmed = |starts| {
            let mut html = String::new();
            arms(&mut html, &Autopsy { starts, ..found.clone() }).expect("the arms");
            html.matches("data-label=\"Harmed of solved starts\">–<").count()
        };
        assert_eq!([harmed(30), harmed(3)], [1, 3], "starts without solved ones harm none");
        let first = |repairs| {
            let mut html = String::new();
            contributions(&mut html, &Autopsy { repairs, ..found.clone() }).expect("the contributions");
            html.matches("data-label=\"Ranks first\">–<").count()
        };
        assert_eq!([first(found.repairs.clone()), first(vec![])], [0, 2], "nothing ranks first without failures");
    }

    #[test]
    fn page_has_the_verdict_all_arms_and_the_strips_of_repaired_starts() {
        let strip = |start| FrameStrip { start, set: "D".to_owned(), png: vec![1, 2, 3] };
        let page = AutopsyPage {
            title: "Autopsy of <b>x</b>".to_owned(),
            env: "swm/TwoRoom-v1".to_owned(),
            found: autopsy(),
            probes: Some(probes()),
            strips: vec![strip(4), strip(5)],
            command: "swm autopsy x -o y".to_owned(),
        };
        let folder = tempfile::tempdir().expect("a folder");
        let html = std::fs::read_to_string(write_autopsy(&page, folder.path()).expect("a page")).expect("the page");
        for part in [
            "Culprit: true dynamics (the model predicts",
            "30 starts, 3 failures · 3 planning seeds",
            "<b>Start 4</b> (episode 7, step 25): D or DE.",
            "<b>Start 6</b>: the unchanged policy solves it",
            "<b>Start 9</b>: no arm solves it.",
            "Autopsy of &lt;b&gt;x",
            "swm autopsy x -o y",
            "<th scope=\"row\">state[0]</th><td class=\"n\" data-label=\"R², linear\">0.912</td>",
            "data-label=\"R², network\">0.987</td><td class=\"n\" data-label=\"R², pos_agent alone\">0.250</td>",
            "<th scope=\"row\">sin state[4]</th><td class=\"n\" data-label=\"R², linear\">–</td>",
            "an R² that is not above it does not show",
        ] {
            assert!(html.contains(part), "{part}");
        }
        assert_eq!(html.matches("data:image/png").count(), 1, "the strip of a start without a repair is left out");
        crate::plot::check_texts(&html, 4);
    }
}
