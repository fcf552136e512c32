//! Tables of a study as CSV, LaTeX and Markdown.

use super::csv;
use clap::ValueEnum;
use std::collections::{BTreeMap, BTreeSet};
use swm_core::results::{BreakingPoint, ImageRank, OverSeeds, StudyResults, StudyRow, Verdict};
use swm_core::text::printable;
use swm_core::{Error, Result};
use swm_eval::{AnyStudy, StudyFolder};

/// The format of a table.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// Comma-separated values, a row for each cell
    Csv,
    /// Comma-separated values, a row for each policy over its training seeds
    CsvSeeds,
    /// A LaTeX table with the booktabs package, conditions by policies
    Latex,
    /// A Markdown table, conditions by policies
    Markdown,
}

impl Format {
    /// Writes the table of the study in a folder.
    ///
    /// # Errors
    /// When the folder has no study or it is damaged, or it has no training seeds.
    pub fn of(self, folder: &StudyFolder) -> Result<String> {
        match folder.open()? {
            AnyStudy::Evaluations(study) => Ok(self.write(&study.results(folder)?)),
            AnyStudy::Table(_) if self == Self::CsvSeeds => {
                let problem = "the cells of this study are no evaluations, so it has no training seeds";
                Err(Error::config("csv-seeds", problem, "choose csv"))
            }
            AnyStudy::Table(study) => Ok(self.write_table(&study.results(folder)?)),
        }
    }

    /// Writes the results of a study.
    pub fn write(self, results: &StudyResults) -> String {
        match self {
            Self::Csv => csv::cells(results),
            Self::CsvSeeds => csv::seeds(results),
            Self::Latex => Pivot::new(results).latex(),
            Self::Markdown => Pivot::new(results).markdown(),
        }
    }
}

/// Escapes a cell of a Markdown table.
pub fn escape_markdown(text: &str) -> String {
    let text =
        printable(text).replace('&', "&amp;").replace('<', "&lt;").replace('|', "\\|").replace(['\n', '\r'], " ");
    // This would be a link or an image.
    text.replace("](", "]\\(")
}

/// The most entries of a table with a column for each policy. A study whose conditions have a policy each would have 10^8.
const MOST_ENTRIES: usize = 200_000;

/// Success rates with a row for each condition and a column for each policy.
struct Pivot<'a> {
    results: &'a StudyResults,
    /// The names of the rows.
    conditions: Vec<String>,
    policies: Vec<&'a str>,
    /// The first row of each name and policy, by their positions.
    cells: BTreeMap<(usize, usize), &'a StudyRow>,
}

/// The condition of every row, with the values of the variables in which rows differ that are equal otherwise, such as those of a list
/// of budgets.
pub(super) fn conditions(results: &StudyResults) -> Vec<String> {
    let mut first = BTreeMap::new();
    let mut several = BTreeSet::new();
    for row in &results.rows {
        let key = (&row.starts, row.counting.name(), row.seed, &row.condition, &row.policy);
        let other = *first.entry(key).or_insert(row);
        let variables = row.variables.keys().chain(other.variables.keys());
        several.extend(variables.filter(|variable| row.variables.get(*variable) != other.variables.get(*variable)));
    }
    let name = |row: &StudyRow| {
        let values = several.iter().filter_map(|variable| Some((variable, row.variables.get(*variable)?)));
        values.fold(row.condition.clone(), |name, (variable, value)| format!("{name}, {variable} {value}"))
    };
    results.rows.iter().map(name).collect()
}

/// The names of all rows: the condition, and what else differs between the cells of the study.
fn names(results: &StudyResults) -> Vec<String> {
    let rows = &results.rows;
    let differs = |of: fn(&StudyRow) -> String| {
        let first = rows.first().map(of);
        rows.iter().any(|row| Some(of(row)) != first)
    };
    let by_starts = differs(|row| row.starts.clone());
    let by_counting = differs(|row| row.counting.name().to_owned());
    let by_seed = differs(|row| row.seed.to_string());
    let name = |(row, mut name): (&StudyRow, String)| {
        if by_starts {
            name += &format!(" ({})", row.starts);
        }
        if by_counting {
            name += &format!(", {}", row.counting.name());
        }
        if by_seed {
            name += &format!(", seed {}", row.seed);
        }
        name
    };
    rows.iter().zip(conditions(results)).map(name).collect()
}

impl<'a> Pivot<'a> {
    fn new(results: &'a StudyResults) -> Self {
        let (mut conditions, mut policies, mut cells) = (vec![], vec![], BTreeMap::new());
        let (mut known_conditions, mut known_policies) = (BTreeMap::new(), BTreeMap::new());
        for (row, name) in results.rows.iter().zip(names(results)) {
            let condition = *known_conditions.entry(name.clone()).or_insert_with(|| {
                conditions.push(name);
                conditions.len() - 1
            });
            let policy = *known_policies.entry(row.policy.as_str()).or_insert_with(|| {
                policies.push(row.policy.as_str());
                policies.len() - 1
            });
            cells.entry((condition, policy)).or_insert(row);
        }
        Self { results, conditions, policies, cells }
    }

    /// The success rate of a cell with its interval, in percent, and the mark of its verdict.
    fn cell(&self, condition: usize, policy: usize) -> String {
        self.cells.get(&(condition, policy)).filter(|row| row.success.n > 0).map_or("–".to_owned(), |row| {
            let [rate, low, high] = [row.success.rate, row.success.low, row.success.high].map(|share| 100.0 * share);
            let mark = match row.gap.map(|gap| gap.verdict) {
                Some(Verdict::Lower) => " ↓",
                Some(Verdict::Higher) => " ↑",
                Some(Verdict::TooFew) => " ?",
                Some(Verdict::NotToldApart) | None => "",
            };
            format!("{rate:.1} [{low:.0}, {high:.0}]{mark}")
        })
    }

    /// What the marks mean, and what the families of comparisons can show.
    fn notes(&self) -> Vec<String> {
        let mut notes = vec![];
        if !self.results.families.is_empty() {
            notes.push(format!(
                "↓ lower, ↑ higher than the first condition on the same starts; unmarked: not told apart; ?: too few \
                     starts differ to tell any difference. {}, corrected for the comparisons of a family.",
                if self.results.until.is_some() { "E-values of paired starts" } else { "Paired score test" }
            ));
        }
        notes.extend(self.results.notes_on_rule());
        notes.extend(self.results.breaking.iter().flat_map(BreakingPoint::sentences));
        notes.extend(self.results.families.iter().map(|family| format!("{}: {family}.", family.name)));
        notes
    }

    /// The rows of the table over training seeds, the header first; empty if no policy has several.
    fn over_seeds(&self) -> Vec<Vec<String>> {
        let header = ["condition", "policy", "training seeds", "mean success, %", "new seed [95 %]", "IQM [95 %]"];
        let rows = over_seeds(self.results);
        if rows.is_empty() {
            return vec![];
        }
        std::iter::once(header.map(str::to_owned).to_vec()).chain(rows).collect()
    }

    /// The conditions by image distance, the header first; empty if none has one.
    fn image_distances(&self) -> Vec<Vec<String>> {
        let ranks = self.results.by_image_distance();
        if ranks.is_empty() {
            return vec![];
        }
        let policies = &self.policies[..self.policies.len().min(MOST_ENTRIES / ranks.len())];
        let gaps = policies.iter().map(|policy| format!("gap of {policy}, points"));
        let header = ["condition", "image distance, 0 to 255"].map(str::to_owned).into_iter().chain(gaps);
        let row = |rank: &ImageRank<'_>| {
            let gap =
                |policy: &&str| rank.gaps.get(policy).map_or("–".to_owned(), |gap| format!("{:+.1}", 100.0 * gap));
            let distance = format!("{:.2}", rank.distance);
            [rank.condition.to_owned(), distance].into_iter().chain(policies.iter().map(gap)).collect()
        };
        std::iter::once(header.collect()).chain(ranks.iter().map(row)).collect()
    }

    /// The rows of the table, the header first. If the table would have more than [`MOST_ENTRIES`], it has a row for each
    /// cell instead.
    fn rows(&self) -> Vec<Vec<String>> {
        if self.conditions.len().saturating_mul(self.policies.len()) > MOST_ENTRIES {
            let header = ["condition", "policy", "success, % [95 %]"].map(str::to_owned).to_vec();
            let row = |&(condition, policy): &(usize, usize)| {
                vec![self.conditions[condition].clone(), self.policies[policy].to_owned(), self.cell(condition, policy)]
            };
            return std::iter::once(header).chain(self.cells.keys().map(row)).collect();
        }
        let header = std::iter::once("success, % [95 %]").chain(self.policies.iter().copied()).map(str::to_owned);
        let row = |(condition, name): (usize, &String)| {
            let cells = (0..self.policies.len()).map(|policy| self.cell(condition, policy));
            std::iter::once(name.clone()).chain(cells).collect()
        };
        std::iter::once(header.collect()).chain(self.conditions.iter().enumerate().map(row)).collect()
    }

    fn markdown(&self) -> String {
        let line = |cells: &[String]| {
            format!("| {} |\n", cells.iter().map(|cell| escape_markdown(cell)).collect::<Vec<_>>().join(" | "))
        };
        let table = |rows: &[Vec<String>]| {
            let [header, rest @ ..] = rows else { return String::new() };
            let rule = vec!["---".to_owned(); header.len()];
            line(header) + &line(&rule) + &rest.iter().map(|row| line(row)).collect::<String>()
        };
        let mut parts = vec![table(&self.rows())];
        parts.extend(self.notes().iter().map(|note| format!("{}\n", escape_markdown(note))));
        parts.extend([self.over_seeds(), self.image_distances()].iter().map(|rows| table(rows)));
        parts.retain(|part| !part.is_empty());
        parts.join("\n")
    }

    fn latex(&self) -> String {
        let table = |rows: &[Vec<String>]| {
            let line = |cells: &Vec<String>| {
                format!("    {} \\\\\n", cells.iter().map(|cell| latex(cell)).collect::<Vec<_>>().join(" & "))
            };
            let [header, rest @ ..] = rows else { return String::new() };
            format!(
                "\\begin{{tabular}}{{l{}}}\n    \\toprule\n{}    \\midrule\n{}    \\bottomrule\n\\end{{tabular}}\n",
                "c".repeat(header.len() - 1),
                line(header),
                rest.iter().map(line).collect::<String>(),
            )
        };
        let notes = self.notes().iter().map(|note| format!("\n{}\n", latex(note))).collect::<String>();
        let more = [self.over_seeds(), self.image_distances()].map(|rows| table(&rows));
        let more = more.iter().filter(|table| !table.is_empty()).map(|table| format!("\n{table}"));
        table(&self.rows()) + &notes + &more.collect::<String>()
    }
}

/// Escapes a text for LaTeX.
pub(super) fn latex(text: &str) -> String {
    let escape = |c| match c {
        '&' | '%' | '$' | '#' | '_' | '{' | '}' => format!("\\{c}"),
        '\\' => "\\textbackslash{}".to_owned(),
        '~' => "\\textasciitilde{}".to_owned(),
        '^' => "\\textasciicircum{}".to_owned(),
        '–' => "--".to_owned(),
        '↓' => "$\\downarrow$".to_owned(),
        '↑' => "$\\uparrow$".to_owned(),
        '·' => "$\\cdot$".to_owned(),
        '\n' => " ".to_owned(),
        c => c.to_string(),
    };
    printable(text).chars().map(escape).collect()
}

/// The rows over training seeds: condition, policy, the rate of each seed, mean, interval of a new seed, interquartile
/// mean. Rates are in percent.
pub fn over_seeds(results: &StudyResults) -> Vec<Vec<String>> {
    let several = |of: &dyn Fn(&OverSeeds) -> String| {
        results.over_seeds.first().is_some_and(|first| results.over_seeds.iter().any(|row| of(row) != of(first)))
    };
    let by_starts = several(&|row| row.starts.clone());
    let (by_counting, by_seed) = (several(&|row| row.counting.to_string()), several(&|row| row.seed.to_string()));
    let row = |row: &OverSeeds| {
        let mut condition = row.condition.clone().unwrap_or_else(|| "all shifted conditions".to_owned());
        if by_starts {
            condition += &format!(" ({})", row.starts);
        }
        if by_counting {
            condition += &format!(", {}", row.counting);
        }
        if by_seed {
            condition += &format!(", seed {}", row.seed);
        }
        let scores = row.scores.iter().map(|(seed, rate)| format!("{seed}: {:.0}", 100.0 * rate));
        let [low, high] = row.new_seed.map(|rate| 100.0 * rate);
        vec![
            condition,
            row.policy.clone(),
            scores.collect::<Vec<_>>().join(", "),
            format!("{:.1}", 100.0 * row.mean),
            format!("[{low:.0}, {high:.0}]"),
            row.interquartile.map_or("–".to_owned(), |iqm| {
                let [mean, low, high] = [iqm.mean, iqm.low, iqm.high].map(|rate| 100.0 * rate);
                format!("{mean:.1} [{low:.0}, {high:.0}]")
            }),
        ]
    };
    results.over_seeds.iter().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::{Duration, Instant};
    use swm_core::results::{Counting, Family, Paired, Proportion, TRAINING_SEED};

    fn results() -> StudyResults {
        let row = |policy: &str, condition: &str, successes: usize, gap: Option<Paired>| StudyRow {
            cell: "00".to_owned(),
            starts: "test".to_owned(),
            condition: condition.to_owned(),
            variables: BTreeMap::from([
                ("count".to_owned(), "2".to_owned()),
                (TRAINING_SEED.to_owned(), policy.trim_start_matches("LeWM_").to_owned()),
            ]),
            policy: policy.to_owned(),
            any_seed: Some("LeWM_*".to_owned()),
            counting: Counting::default(),
            seed: 0,
            success: Proportion::wilson(successes, 10),
            solved_at_start: 0,
            floor: Proportion::wilson(0, 10),
            gap,
            trained_on_starts: None,
            image_distance: None,
            prediction: None,
            played: None,
            by_displacement: vec![],
        };
        let mut gap = Paired::of(4, 0, 5, 1);
        let families = Vec::from_iter(Family::correct("LeWM_1 · seed 0", &mut [&mut gap], 1));
        let rows = vec![
            row("LeWM_1", "plain", 9, None),
            row("LeWM_1", "red, 50 %", 4, Some(gap)),
            row("LeWM_2", "plain", 7, None),
        ];
        let over_seeds = OverSeeds::all(&rows, "plain");
        let [title, question, hash] = ["t", "q?", "h"].map(str::to_owned);
        StudyResults { title, question, hash, cells: 4, done: 3, rows, families, over_seeds, ..StudyResults::default() }
    }

    #[test]
    fn cells_that_differ_in_a_variable_have_rows_of_their_own() {
        let mut results = results();
        for row in &mut results.rows {
            row.variables.insert("budget".to_owned(), "20".to_owned());
        }
        let plain = Format::Markdown.write(&results);
        assert!(!plain.contains("budget"), "{plain}");
        let mut again = results.rows[0].clone();
        again.variables.insert("budget".to_owned(), "40".to_owned());
        again.success = Proportion::wilson(3, 10);
        results.rows.push(again);
        for format in [Format::Latex, Format::Markdown] {
            let table = format.write(&results);
            for expected in ["plain, budget 20", "plain, budget 40", "30.0 [", "90.0 ["] {
                assert!(table.contains(expected), "{table}");
            }
            assert!(!table.contains("count 2"), "{table}");
        }
    }

    #[test]
    fn of_no_episodes_there_is_no_rate() {
        let mut results = results();
        for row in &mut results.rows {
            (row.success, row.floor, row.gap) = (Proportion::wilson(0, 0), Proportion::wilson(0, 0), None);
        }
        let markdown = Format::Markdown.write(&results);
        assert_eq!(markdown.lines().nth(2), Some("| plain | – | – |"));
        let csv = Format::Csv.write(&results);
        assert!(csv.lines().nth(1).is_some_and(|line| line.contains(",0,0,,,,")), "{csv}");
    }

    #[test]
    fn tables_of_the_largest_study_take_little_time() {
        let small = results();
        let rows = (0..10_000_u64).map(|index| StudyRow {
            condition: format!("condition {}", index / 2),
            policy: format!("policy {}", index % 2),
            seed: index % 3,
            ..small.rows[0].clone()
        });
        // The first of two rows of a cell is shown.
        let second = StudyRow { success: Proportion::wilson(1, 10), ..small.rows[0].clone() };
        let second = StudyRow { condition: "condition 0".to_owned(), policy: "policy 0".to_owned(), ..second };
        let results = StudyResults { rows: rows.chain([second]).collect(), ..small };
        let start = Instant::now();
        for format in [Format::Csv, Format::Latex, Format::Markdown] {
            let table = format.write(&results);
            assert!(table.lines().count() >= 10_000 && table.contains("condition 4999"), "{}", table.len());
        }
        let markdown = Format::Markdown.write(&results);
        assert!(markdown.contains("| condition 0, seed 0 | 90.0 [60, 98] | – |\n"), "a row of the first cells");
        assert!(start.elapsed() < Duration::from_secs(10), "{:?}", start.elapsed());
    }

    #[test]
    fn table_of_many_conditions_and_policies_has_a_row_for_each_cell() {
        let small = results();
        let row = |index: usize| StudyRow {
            condition: format!("condition {index}"),
            policy: format!("policy {index}"),
            image_distance: Some(1.0),
            ..small.rows[0].clone()
        };
        let results = StudyResults { rows: (0..10_000).map(row).collect(), ..small.clone() };
        for format in [Format::Latex, Format::Markdown] {
            let table = format.write(&results);
            assert!(table.len() < 8_000_000 && table.contains("condition 9999"), "{} bytes", table.len());
        }
        let markdown = Format::Markdown.write(&results);
        assert!(markdown.contains("| condition 7 | policy 7 | 90.0 [60, 98] |\n"), "a row for each cell");
    }

    #[test]
    fn tables_escape_what_their_formats_reserve() {
        let results = results();
        let csv = Format::Csv.write(&results);
        assert_eq!(csv.lines().count(), 4);
        assert!(csv.lines().nth(2).is_some_and(|line| line.ends_with(",1,lower,")), "{csv}");
        assert!(
            csv.lines().nth(2).is_some_and(|line| line.contains("\"red, 50 %\"") && line.contains(",0.4,")),
            "{csv}"
        );
        let latex = Format::Latex.write(&results);
        assert!(
            latex.contains("LeWM\\_1")
                && latex.contains("red, 50 \\%")
                && latex.contains("40.0 [17, 69] $\\downarrow$"),
            "{latex}"
        );
        assert_eq!(escape_markdown("![a](http://b) [c]"), "![a]\\(http://b) [c]");
        let markdown = Format::Markdown.write(&results);
        assert_eq!(markdown.lines().nth(2), Some("| plain | 90.0 [60, 98] | 70.0 [40, 89] |"));
        assert!(markdown.contains("\n| red, 50 % | 40.0 [17, 69] ↓ | – |\n\n↓ lower, "), "{markdown}");
        assert!(markdown.contains("LeWM_1 · seed 0: 1 comparison of 10 pairs tells a difference of "), "{markdown}");
        let seeds = Format::CsvSeeds.write(&results);
        assert!(seeds.ends_with("\ntest,plain,LeWM_*,strict,0,1;2,0.9;0.7,0.8,0,1,,,\n"), "{seeds}");
        assert!(markdown.ends_with("| plain | LeWM_* | 1: 90, 2: 70 | 80.0 | [0, 100] | – |\n"), "{markdown}");
        assert!(latex.contains("LeWM\\_1 $\\cdot$ seed 0") && latex.ends_with("\\end{tabular}\n"), "{latex}");
    }
}
