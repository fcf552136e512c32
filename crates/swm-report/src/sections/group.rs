//! The section of a group: success rates, videos, comparisons, time to goal, latency, searches and prediction errors.

use super::Room;
use super::videos::Gallery;
use super::{cards, comparisons, runs_table, verdict};
use crate::charts;
use crate::gap::Gaps;
use crate::group::{Compared, Group};
use crate::limits;
use std::fmt::Write as _;
use std::path::PathBuf;
use swm_core::results::Counting;
use swm_core::{Result, Results};

/// A group with what its section shows.
pub(crate) struct Shown<'g, 'a> {
    group: &'g Group<'a>,
    compared: Vec<Compared<'g, 'a>>,
    gaps: Vec<Gaps<'g, 'a>>,
    gallery: Gallery<'a>,
}

impl<'g, 'a> Shown<'g, 'a> {
    /// Compares the runs of a group; `gallery` has its videos.
    pub(crate) fn new(group: &'g Group<'a>, results: &[(PathBuf, Results)], gallery: Gallery<'a>) -> Self {
        Self { group, compared: Compared::all(group), gaps: Gaps::all(group, results), gallery }
    }

    /// What the group shows, in one sentence.
    pub(crate) fn sentence(&self) -> Option<String> {
        verdict::sentence(self.group, &self.compared, &self.gaps)
    }

    /// The heading of the group, escaped.
    pub(crate) fn title(&self) -> String {
        self.group.title()
    }

    /// Writes the section; its heading names the group if there are `several`.
    ///
    /// # Errors
    /// When drawing fails.
    pub(crate) fn write(&self, html: &mut String, several: bool, room: &mut Room) -> Result<()> {
        let group = self.group;
        let _ = write!(html, "<section>\n<h2>{}</h2>\n", if several { group.title() } else { "Success".to_owned() });
        if group.rows().next().is_none() {
            html.push_str("<p class=\"note\">These results contain no runs.</p>\n</section>\n");
            return Ok(());
        }
        cards::write(html, group, &self.compared);
        let _ = writeln!(html, "<p class=\"note\">{}</p>", counting_words(group));
        for (stopping, episodes) in group.stopped.iter().take(limits::SENTENCES) {
            let _ = writeln!(html, "<p class=\"note\">{}.</p>", stopping.note(*episodes));
        }
        success(html, group, room)?;
        html.push_str(&self.gallery.html);
        comparisons::gaps(html, &self.gaps, room)?;
        comparisons::write(html, &self.compared, room)?;
        self.time_to_goal(html, room)?;
        planning(html, group, room)?;
        let each = group.conditions.iter().flat_map(|condition| condition.rows.iter().map(|row| (row, condition.name)));
        let caption = "Mean squared errors of latents predicted open loop along recorded trajectories, in units of the latents’ \
                       variance: always predicting the mean has the error 1. Solved and unsolved starts are shown \
                       separately; dots are medians.";
        let errors = each.map(|(row, condition)| charts::prediction::charts(row, condition));
        room.panels(html, ["Prediction errors", caption], errors)?;
        html.push_str("</section>\n");
        Ok(())
    }

    /// The time to goal and the outcome of every episode.
    fn time_to_goal(&self, html: &mut String, room: &mut Room) -> Result<()> {
        let group = self.group;
        let longest = group.rows().flat_map(|row| &row.run.episodes).map(|episode| episode.steps).max().unwrap_or(0);
        if longest == 0 {
            return Ok(());
        }
        let caption = "The fraction of the counted episodes that had reached the goal after a number of steps.";
        let chart = |condition| charts::time_to_goal::chart(condition, group.counting, longest);
        let curves = group.conditions.iter().map(|condition| Ok(chart(condition)?.into_iter().collect()));
        room.panels(html, ["Time to goal", caption], curves)?;
        let episodes: usize = group.rows().map(|row| row.run.episodes.len()).sum();
        let caption = format!(
            "One square for each episode, in order: filled if the goal was reached, empty if it was not, faint if the \
             episode was solved at the start.{}{}",
            if self.gallery.ids.is_empty() { "" } else { " Squares with a dark outline link to the videos." },
            if episodes > limits::SQUARES { " Further runs are left out." } else { "" }
        );
        room.figure(html, "Every episode", &caption, &charts::episodes::chart(group, &self.gallery.ids)?);
        Ok(())
    }
}

/// Success rates and the table of runs.
fn success(html: &mut String, group: &Group<'_>, room: &mut Room) -> Result<()> {
    let runs = group.rows().count();
    let caption = format!(
        "Points are success rates, whiskers their 95 % {}. The band is the confidence interval \
         of the random policy under the same condition, the dashed line its success rate: the random-policy floor.{}",
        if group.stopped.is_empty() {
            "Wilson confidence intervals"
        } else {
            "confidence sequences (Wilson intervals where the \
         number of episodes was fixed)"
        },
        if runs > limits::CHART_ROWS {
            format!(" The first {} of {runs} runs are drawn.", limits::CHART_ROWS)
        } else {
            String::new()
        }
    );
    room.figure(html, "Success rates", &caption, &charts::success::chart(group)?);
    runs_table::write(html, group, room);
    Ok(())
}

/// Planning latency and the searches of plans.
fn planning(html: &mut String, group: &Group<'_>, room: &mut Room) -> Result<()> {
    if let Some(chart) = charts::latency::chart(group)? {
        let caption = "The time of one planning call: the bar ends at the median, the whisker at the 95th percentile; the values \
                       are on the right.";
        room.figure(html, "Planning latency", caption, &chart);
    }
    let caption = "Lines are medians over all plans of a run, bands reach from the 10th to the 90th percentile. If the cost \
                   still falls at the end, more iterations would help; if the spread vanishes long before, fewer \
                   iterations suffice.";
    let each = group.conditions.iter().flat_map(|condition| condition.rows.iter().map(|row| (row, condition.name)));
    room.panels(html, ["Searches", caption], each.map(|(row, condition)| charts::searches::charts(row, condition)))
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
