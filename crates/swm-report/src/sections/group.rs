//! The section of a group: success rates, comparisons, time to goal, latency, searches, prediction errors and videos.

use super::figure;
use super::videos::Videos;
use super::{cards, runs_table};
use crate::charts;
use crate::group::Group;
use crate::text::escape;
use std::fmt::Write as _;
use std::path::PathBuf;
use swm_core::Results;
use swm_core::results::{Counting, MAX_ALL_PAIRS};

/// Writes the section; its heading names the group if there are `several`. `videos` are those of the page.
pub(crate) fn write(
    html: &mut String,
    group: &Group<'_>,
    (results, videos): (&[(PathBuf, Results)], &mut Videos),
    several: bool,
) {
    let _ = write!(html, "<section>\n<h2>{}</h2>\n", if several { group.title() } else { "Success".to_owned() });
    if group.rows().next().is_none() {
        html.push_str("<p class=\"note\">These results contain no runs.</p>\n</section>\n");
        return;
    }
    cards::write(html, group);
    let _ = writeln!(html, "<p class=\"note\">{}</p>", counting_words(group));
    success(html, group);
    time_to_goal(html, group);
    planning(html, group);
    prediction_errors(html, group);
    videos.write(html, group, results);
    html.push_str("</section>\n");
}

/// Success rates, the table of runs, and paired comparisons.
fn success(html: &mut String, group: &Group<'_>) {
    figure(
        html,
        "Success rates",
        "Points are success rates, whiskers their 95 % Wilson confidence intervals. The band is the confidence interval \
         of the random policy under the same condition, the dashed line its success rate: the random-policy floor.",
        &charts::success::chart(group),
    );
    runs_table::write(html, group);
    if let Some(chart) = charts::paired::chart(group) {
        let limited = group.conditions.iter().any(|condition| condition.rows.len() > MAX_ALL_PAIRS);
        let limit = format!(
            " With more than {MAX_ALL_PAIRS} runs, each is compared with the random-policy floor and with the run of the \
             highest success rate only."
        );
        let caption = format!(
            "Points are differences of success rates over starts that both policies played, whiskers their confidence \
             intervals (Tango’s, the inversion of the paired score test). The intervals of one condition hold together \
             with 95 %: intervals and p-values are corrected for the number of pairs (Bonferroni). A policy is higher or \
             lower where the interval excludes 0. “Too few” means that the starts which exactly one policy solved would \
             not decide even if the same policy had solved all of them.{}",
            if limited { limit.as_str() } else { "" }
        );
        figure(html, "On the same starts", &caption, &chart);
        html.push_str(&charts::paired::table(group));
    }
}

/// The time to goal and the outcome of every episode.
fn time_to_goal(html: &mut String, group: &Group<'_>) {
    let longest = group.rows().flat_map(|row| &row.run.episodes).map(|episode| episode.steps).max().unwrap_or(0);
    if longest == 0 {
        return;
    }
    let chart = |condition| charts::time_to_goal::chart(condition, group.counting, longest);
    let curves: String = group.conditions.iter().map(chart).collect();
    figure(
        html,
        "Time to goal",
        "The fraction of the counted episodes that had reached the goal after a number of steps.",
        &format!("<div class=\"pair\">\n{curves}</div>\n{}", legend(group)),
    );
    figure(
        html,
        "Every episode",
        "One square for each episode, in order: filled if the goal was reached, empty if it was not, faint if the \
         episode was solved at the start.",
        &charts::episodes::chart(group),
    );
}

/// Planning latency and the searches of plans.
fn planning(html: &mut String, group: &Group<'_>) {
    if let Some(chart) = charts::latency::chart(group) {
        figure(
            html,
            "Planning latency",
            "The time of one planning call: the bar ends at the median, the whisker at the 95th percentile; the values \
             are on the right.",
            &chart,
        );
    }
    let searches: String = group.conditions.iter().map(charts::searches::charts).collect();
    if !searches.is_empty() {
        figure(
            html,
            "Searches",
            "Lines are medians over all plans of a run, bands reach from the 10th to the 90th percentile. If the cost \
             still falls at the end, more iterations would help; if the spread vanishes long before, fewer \
             iterations suffice.",
            &format!("<div class=\"pair\">\n{searches}</div>\n"),
        );
    }
}

/// The prediction errors of models.
fn prediction_errors(html: &mut String, group: &Group<'_>) {
    let errors: String = group.conditions.iter().map(charts::prediction::charts).collect();
    if !errors.is_empty() {
        figure(
            html,
            "Prediction errors",
            "Mean squared errors of latents predicted open loop along recorded trajectories, in units of the latents’ \
             variance: always predicting the mean has the error 1. Solved and unsolved starts are shown \
             separately; dots are medians.",
            &format!("<div class=\"pair\">\n{errors}</div>\n"),
        );
    }
}

/// The counting of the group in words.
fn counting_words(group: &Group<'_>) -> String {
    // All policies of a condition have the same starts.
    let most = |condition: &crate::group::Condition<'_>| condition.rows.iter().map(|row| row.run.solved_at_start).max();
    let solved: usize = group.conditions.iter().filter_map(most).sum();
    match group.counting {
        Counting::Strict { hold } => {
            let held = match hold {
                1 => "at the first step that satisfies the goal".to_owned(),
                _ => format!("once the goal was satisfied for {hold} steps in a row"),
            };
            let solved_at_start = match solved {
                0 => "No episode was solved at the start.".to_owned(),
                1 => "One episode was solved at the start; it was not played and does not count.".to_owned(),
                _ => format!("{solved} episodes were solved at the start; they were not played and do not count."),
            };
            format!("Strict counting: an episode succeeds {held}. {solved_at_start}")
        }
        Counting::Compat { envs } => {
            let first = match group.protocol {
                "episodic" => format!(
                    " The first episodes to finish in {envs} parallel environments count, so policies may play different \
                     starts; only policies with the same starts are compared start by start."
                ),
                _ => String::new(),
            };
            format!(
                "Compat counting, as in the Python package stable-worldmodel: every episode counts, solved at the start \
                 or not ({solved} were), and an episode succeeds when the environment terminates.{first}"
            )
        }
    }
}

/// The legend of policies, shared by all conditions.
fn legend(group: &Group<'_>) -> String {
    let mut seen: Vec<(&str, &str)> = vec![];
    for row in group.rows() {
        if !seen.contains(&(&row.class, &row.run.policy)) {
            seen.push((&row.class, &row.run.policy));
        }
    }
    let mut html = "<ul class=\"legend\">\n".to_owned();
    for (class, policy) in seen {
        let _ = writeln!(
            html,
            "<li><svg viewBox=\"0 0 28 8\" width=\"28\" height=\"8\" aria-hidden=\"true\"><line class=\"curve {class}\" \
             x1=\"0\" y1=\"4\" x2=\"28\" y2=\"4\"/></svg> {}</li>",
            escape(policy)
        );
    }
    html.push_str("</ul>\n");
    html
}
