//! Tables of a study as CSV, LaTeX and Markdown.

use clap::ValueEnum;
use swm_core::results::{StudyResults, StudyRow};
use swm_core::text::printable;

/// The format of a table.
#[derive(Clone, Copy, ValueEnum)]
pub enum Format {
    /// Comma-separated values, a row for each cell
    Csv,
    /// A LaTeX table with the booktabs package, conditions by policies
    Latex,
    /// A Markdown table, conditions by policies
    Markdown,
}

impl Format {
    /// Writes the results of a study.
    pub fn write(self, results: &StudyResults) -> String {
        match self {
            Self::Csv => csv(results),
            Self::Latex => Pivot::new(results).latex(),
            Self::Markdown => Pivot::new(results).markdown(),
        }
    }
}

fn csv(results: &StudyResults) -> String {
    let mut variables: Vec<&str> =
        results.rows.iter().flat_map(|row| row.variables.keys().map(String::as_str)).collect();
    variables.sort_unstable();
    variables.dedup();
    let quote = |text: &str| {
        // A spreadsheet would run a name that begins like a formula.
        let is_formula = text.starts_with(['=', '+', '-', '@']) && text.parse::<f64>().is_err();
        let text = &format!("{}{}", if is_formula { "'" } else { "" }, printable(text));
        if text.contains([',', '"', '\n', '\r']) {
            format!("\"{}\"", text.replace('"', "\"\""))
        } else {
            text.to_owned()
        }
    };
    let mut header = vec!["cell", "starts", "condition", "policy", "counting", "seed"];
    let columns: Vec<String> = variables.iter().map(|name| format!("variable.{name}")).collect();
    header.extend(columns.iter().map(String::as_str));
    header.extend([
        "successes",
        "n",
        "rate",
        "low",
        "high",
        "solved_at_start",
        "floor",
        "gap",
        "gap_low",
        "gap_high",
        "p",
    ]);
    let mut text = header.iter().map(|name| quote(name)).collect::<Vec<_>>().join(",") + "\n";
    for row in &results.rows {
        let mut cells = vec![row.cell.clone(), row.starts.clone(), row.condition.clone(), row.policy.clone()];
        cells.extend([row.counting.name().to_owned(), row.seed.to_string()]);
        cells.extend(variables.iter().map(|name| row.variables.get(*name).cloned().unwrap_or_default()));
        let success = &row.success;
        cells.extend([success.successes.to_string(), success.n.to_string()]);
        cells.extend([success.rate, success.low, success.high].map(|share| share.to_string()));
        cells.extend([row.solved_at_start.to_string(), row.floor.rate.to_string()]);
        let gap = row.gap.as_ref().map(|gap| [gap.difference, gap.low, gap.high, gap.p].map(|value| value.to_string()));
        cells.extend(gap.unwrap_or_default());
        text += &(cells.iter().map(|cell| quote(cell)).collect::<Vec<_>>().join(",") + "\n");
    }
    text
}

/// Success rates with a row for each condition and a column for each policy.
struct Pivot<'a> {
    results: &'a StudyResults,
    /// The names of the rows.
    conditions: Vec<String>,
    policies: Vec<&'a str>,
}

/// The name of a row: the condition, and what else differs between the cells of the study.
fn name(row: &StudyRow, results: &StudyResults) -> String {
    let differs = |of: &dyn Fn(&StudyRow) -> String| results.rows.iter().any(|other| of(other) != of(row));
    let mut name = row.condition.clone();
    if differs(&|row| row.starts.clone()) {
        name += &format!(" ({})", row.starts);
    }
    if differs(&|row| row.counting.name().to_owned()) {
        name += &format!(", {}", row.counting.name());
    }
    if differs(&|row| row.seed.to_string()) {
        name += &format!(", seed {}", row.seed);
    }
    name
}

impl<'a> Pivot<'a> {
    fn new(results: &'a StudyResults) -> Self {
        let (mut conditions, mut policies) = (vec![], vec![]);
        for row in &results.rows {
            let name = name(row, results);
            if !conditions.contains(&name) {
                conditions.push(name);
            }
            if !policies.contains(&row.policy.as_str()) {
                policies.push(row.policy.as_str());
            }
        }
        Self { results, conditions, policies }
    }

    /// The success rate of a cell with its interval, in percent.
    fn cell(&self, condition: &str, policy: &str) -> String {
        let row = self.results.rows.iter().find(|row| row.policy == policy && name(row, self.results) == condition);
        row.map_or("–".to_owned(), |row| {
            let [rate, low, high] = [row.success.rate, row.success.low, row.success.high].map(|share| 100.0 * share);
            format!("{rate:.1} [{low:.0}, {high:.0}]")
        })
    }

    fn rows(&self) -> impl Iterator<Item = Vec<String>> + '_ {
        self.conditions.iter().map(|condition| {
            let cells = self.policies.iter().map(|policy| self.cell(condition, policy));
            std::iter::once(condition.clone()).chain(cells).collect()
        })
    }

    fn markdown(&self) -> String {
        let escape = |cell: &str| printable(cell).replace('|', "\\|").replace(['\n', '\r'], " ");
        let line = |cells: &[String]| {
            format!("| {} |\n", cells.iter().map(|cell| escape(cell)).collect::<Vec<_>>().join(" | "))
        };
        let header: Vec<String> =
            std::iter::once("success, % [95 %]").chain(self.policies.iter().copied()).map(str::to_owned).collect();
        let rule: Vec<String> = header.iter().map(|_| "---".to_owned()).collect();
        line(&header) + &line(&rule) + &self.rows().map(|row| line(&row)).collect::<String>()
    }

    fn latex(&self) -> String {
        let escape = |cell: &str| {
            let cell = printable(cell);
            let escaped = cell.chars().map(|c| match c {
                '&' | '%' | '$' | '#' | '_' | '{' | '}' => format!("\\{c}"),
                '\\' => "\\textbackslash{}".to_owned(),
                '~' => "\\textasciitilde{}".to_owned(),
                '^' => "\\textasciicircum{}".to_owned(),
                '–' => "--".to_owned(),
                '\n' => " ".to_owned(),
                c => c.to_string(),
            });
            escaped.collect::<String>()
        };
        let line = |cells: Vec<String>| {
            format!("    {} \\\\\n", cells.iter().map(|cell| escape(cell)).collect::<Vec<_>>().join(" & "))
        };
        let header =
            std::iter::once("success, % [95 %]").chain(self.policies.iter().copied()).map(str::to_owned).collect();
        format!(
            "\\begin{{tabular}}{{l{}}}\n    \\toprule\n{}    \\midrule\n{}    \\bottomrule\n\\end{{tabular}}\n",
            "c".repeat(self.policies.len()),
            line(header),
            self.rows().map(line).collect::<String>(),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use swm_core::results::{Counting, Paired, Proportion};

    fn results() -> StudyResults {
        let row = |condition: &str, successes: usize, gap: Option<Paired>| StudyRow {
            cell: "00".to_owned(),
            starts: "test".to_owned(),
            condition: condition.to_owned(),
            variables: BTreeMap::from([("count".to_owned(), "2".to_owned())]),
            policy: "LeWM_1".to_owned(),
            counting: Counting::default(),
            seed: 0,
            success: Proportion::wilson(successes, 10),
            solved_at_start: 0,
            floor: Proportion::wilson(0, 10),
            gap,
        };
        let rows = vec![row("plain", 9, None), row("red, 50 %", 4, Some(Paired::of(4, 0, 5, 1)))];
        StudyResults { title: "t".to_owned(), question: "q?".to_owned(), hash: "h".to_owned(), cells: 2, done: 2, rows }
    }

    #[test]
    fn tables_escape_what_their_formats_reserve() {
        let results = results();
        let csv = Format::Csv.write(&results);
        assert_eq!(csv.lines().count(), 3);
        assert!(
            csv.lines().nth(2).is_some_and(|line| line.contains("\"red, 50 %\"") && line.contains(",0.4,")),
            "{csv}"
        );
        let latex = Format::Latex.write(&results);
        assert!(
            latex.contains("LeWM\\_1") && latex.contains("red, 50 \\%") && latex.contains("40.0 [17, 69]"),
            "{latex}"
        );
        let markdown = Format::Markdown.write(&results);
        assert_eq!(markdown.lines().nth(2), Some("| plain | 90.0 [60, 98] |"));
    }
}
