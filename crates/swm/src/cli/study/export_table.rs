//! Tables of a study whose cells are no evaluations, as text, CSV, LaTeX and Markdown.

use super::csv;
use super::export::{Format, escape_markdown, latex};
use crate::cli::{emit, emit_json, table};
use swm_core::results::StudyTable;

impl Format {
    /// Writes the table of a study.
    pub fn write_table(self, results: &StudyTable) -> String {
        let lines = |line: &dyn Fn(&[String]) -> String| {
            rows(results, self).iter().map(|row| line(row) + "\n").collect::<Vec<_>>()
        };
        let note = note(results);
        match self {
            Self::Csv | Self::CsvSeeds => rows(results, self).iter().map(|row| csv::line(row)).collect(),
            Self::Markdown => {
                let line = |row: &[String]| {
                    format!("| {} |", row.iter().map(|cell| escape_markdown(cell)).collect::<Vec<_>>().join(" | "))
                };
                let mut lines = lines(&line);
                let rule = format!("| {} |\n", vec!["---"; results.columns.len() + 1].join(" | "));
                lines.insert(1, rule);
                lines.concat() + &note.map_or(String::new(), |note| format!("\n{}\n", escape_markdown(&note)))
            }
            Self::Latex => {
                let line = |row: &[String]| {
                    format!("    {} \\\\", row.iter().map(|cell| latex(cell)).collect::<Vec<_>>().join(" & "))
                };
                let lines = lines(&line);
                format!(
                    "\\begin{{tabular}}{{l{}}}\n    \\toprule\n{}    \\midrule\n{}    \\bottomrule\n\\end{{tabular}}\n{}",
                    "r".repeat(results.columns.len()),
                    lines[0],
                    lines[1..].concat(),
                    note.map_or(String::new(), |note| format!("\n{}\n", latex(&note)))
                )
            }
        }
    }
}

/// Prints the table.
///
/// # Errors
/// When it cannot be written as JSON.
pub fn show(results: &StudyTable, as_json: bool) -> anyhow::Result<()> {
    if as_json {
        return emit_json(results);
    }
    emit(&format!("{}: {} of {} cells\n", results.title, results.done, results.cells));
    let mut rows = rows(results, Format::Markdown).into_iter();
    let header = rows.next().unwrap_or_default();
    emit(&table(&header.iter().map(String::as_str).collect::<Vec<_>>(), rows));
    emit(&note(results).map_or(String::new(), |note| note + "\n"));
    Ok(())
}

/// The rows of the table, the header first. CSV has all digits, the id of the cell, and nothing where a value is missing.
fn rows(results: &StudyTable, format: Format) -> Vec<Vec<String>> {
    let is_csv = matches!(format, Format::Csv | Format::CsvSeeds);
    let mut header: Vec<String> = if is_csv { vec!["cell".to_owned()] } else { vec![] };
    header.push(results.subject.clone());
    header.extend(results.columns.iter().map(|column| column.label()));
    let row = |row: &swm_core::results::TableRow| {
        let mut cells: Vec<String> = if is_csv { vec![row.cell.clone()] } else { vec![] };
        cells.push(row.name.clone());
        let value = |value: &Option<f64>| match value {
            None if is_csv => String::new(),
            None => "–".to_owned(),
            Some(value) if is_csv => value.to_string(),
            Some(value) => number(*value),
        };
        cells.extend(row.values.iter().map(value));
        cells
    };
    std::iter::once(header).chain(results.rows.iter().map(row)).collect()
}

/// The number of rows without values, the machines, and the source of the published values; `None` if there is nothing to say.
fn note(results: &StudyTable) -> Option<String> {
    let mut parts = vec![];
    if results.done < results.cells {
        parts.push(format!("{} of {} rows have no values", results.cells - results.done, results.cells));
    }
    let mut machines: Vec<&str> =
        results.rows.iter().map(|row| row.machine.as_str()).filter(|name| !name.is_empty()).collect();
    machines.sort_unstable();
    machines.dedup();
    if !machines.is_empty() {
        parts.push(format!("measured on {}", machines.join("; ")));
    }
    if !results.source.is_empty() {
        parts.push(format!("published: {}", results.source));
    }
    (!parts.is_empty()).then(|| parts.join("; ") + ".")
}

/// A number with up to three significant digits behind its point.
fn number(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 || value == value.trunc() => format!("{value:.0}"),
        size if size >= 1.0 => format!("{value:.1}"),
        _ => format!("{value:.3}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::{TableColumn, TableRow};

    #[test]
    fn tables_have_published_values_beside_ours_and_dashes_for_what_is_missing() {
        let column =
            |name: &str, unit: &str| TableColumn { name: name.to_owned(), unit: unit.to_owned(), published: false };
        let row = |name: &str, values: &[Option<f64>]| TableRow {
            cell: "00".to_owned(),
            name: name.to_owned(),
            values: values.to_vec(),
            machine: String::new(),
            paths: vec![],
        };
        let results = StudyTable {
            subject: "dataset".to_owned(),
            columns: vec![column("clips/s", "clips/s"), column("latency", "ms")],
            rows: vec![row("hdf5, local", &[Some(1416.25), Some(0.5)]), row("=evil_1", &[None, None])],
            cells: 2,
            done: 1,
            source: "figure 4".to_owned(),
            ..StudyTable::default()
        };
        let csv = Format::Csv.write_table(&results);
        assert_eq!(csv, "cell,dataset,clips/s,\"latency, ms\"\n00,\"hdf5, local\",1416.25,0.5\n00,'=evil_1,,\n");
        let markdown = Format::Markdown.write_table(&results);
        assert!(
            markdown.starts_with(
                "| dataset | clips/s | latency, ms |\n| --- | --- | --- |\n| hdf5, local | 1416 | 0.500 |\n"
            )
        );
        assert!(
            markdown.ends_with("| =evil_1 | – | – |\n\n1 of 2 rows have no values; published: figure 4.\n"),
            "{markdown}"
        );
        let latex = Format::Latex.write_table(&results);
        assert!(latex.starts_with("\\begin{tabular}{lrr}\n    \\toprule\n    dataset & clips/s"), "{latex}");
        assert!(latex.contains("    =evil\\_1 & -- & -- \\\\\n    \\bottomrule"), "{latex}");
    }
}
