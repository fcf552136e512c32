//! Compares the crate table of ARCHITECTURE.md with the workspace.

use crate::graph::Graph;
use anyhow::{Result, bail};

/// A row of the table.
#[derive(Debug, PartialEq)]
pub struct Row {
    /// The crate.
    pub name: String,
    /// The names in backticks in the last column.
    pub may: Vec<String>,
}

/// The rows of the table whose header is `crate | responsibility | may depend on`.
pub fn parse(text: &str) -> Result<Vec<Row>> {
    let mut lines = text.lines().map(cells);
    if !lines.any(|cells| cells.iter().map(|cell| cell.to_lowercase()).eq(["crate", "responsibility", "may depend on"]))
    {
        bail!("ARCHITECTURE.md contains no table with the header | crate | responsibility | may depend on |");
    }
    let mut rows = vec![];
    // The line below the header separates the header from the rows.
    for cells in lines.skip(1).take_while(|cells| !cells.is_empty()) {
        let [name, _, may] = cells[..] else { bail!("a row of the crate table does not have 3 columns: {cells:?}") };
        let [name] = &quoted(name)[..] else { bail!("the crate table does not name one crate in backticks: {name}") };
        rows.push(Row { name: name.clone(), may: quoted(may) });
    }
    Ok(rows)
}

/// Returns the cells of a row of a Markdown table; empty if the line is not a row.
fn cells(line: &str) -> Vec<&str> {
    let inner = line.trim().strip_prefix('|').and_then(|line| line.strip_suffix('|'));
    inner.map(|line| line.split('|').map(str::trim).collect()).unwrap_or_default()
}

/// The words in backticks.
fn quoted(cell: &str) -> Vec<String> {
    cell.split('`').skip(1).step_by(2).map(str::to_owned).collect()
}

/// Returns a sentence for each difference between the table and the workspace.
pub fn violations(graph: &Graph, rows: &[Row]) -> Vec<String> {
    let mut found = vec![];
    for (i, row) in rows.iter().enumerate() {
        if rows[..i].iter().any(|other| other.name == row.name) {
            found.push(format!("the table lists {} twice", row.name));
        }
        if graph.member(&row.name).is_none() {
            found.push(format!("the table lists {}, which is no crate of the workspace", row.name));
        }
        // The table may name third-party packages; names with the prefix of the workspace must be its crates.
        for name in row.may.iter().filter(|name| name.starts_with("swm") && graph.member(name).is_none()) {
            found.push(format!("the table lets {} depend on {name}, which is no crate of the workspace", row.name));
        }
    }
    for package in graph.members() {
        let Some(row) = rows.iter().find(|row| row.name == package.name) else {
            found.push(format!("the table lacks {}; add a row for it to ARCHITECTURE.md", package.name));
            continue;
        };
        for need in graph.member_dependencies(package).filter(|need| !row.may.iter().any(|name| name == need)) {
            found.push(format!(
                "{} depends on {need}, which its row in ARCHITECTURE.md does not allow; fix the dependency or the row",
                package.name
            ));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = "# Map\n\n| other | table |\n| --- | --- |\n\n\
        | crate | responsibility | may depend on |\n|---|:--|---|\n\
        | `swm-core` | words, `Batch` | small crates |\n\
        | `swm-plan` | solvers | `swm-core` |\n\
        | `swm` | all | `swm-core`, `swm-plan`, `clap` |\n\nMore text.\n";

    fn check(text: &str, packages: &[(&str, &[&str])]) -> Vec<String> {
        violations(&Graph::synthetic(packages), &parse(text).expect("parsing the table"))
    }

    const WORKSPACE: &[(&str, &[&str])] =
        &[("swm-core", &["serde"]), ("swm-plan", &["swm-core"]), ("swm", &["swm-plan"]), ("serde", &[])];

    #[test]
    fn a_table_that_matches_the_workspace_passes() {
        assert_eq!(check(TEXT, WORKSPACE), Vec::<String>::new());
    }

    #[test]
    fn differences_between_table_and_workspace_are_reported() {
        let reports = |text: &str, packages: &[(&str, &[&str])], words: &str| {
            let found = check(text, packages);
            assert!(found.len() == 1 && found[0].contains(words), "{words}: {found:?}");
        };
        reports(
            &TEXT.replace("| `swm-plan` | solvers | `swm-core` |", "| `swm-plan` | solvers | |"),
            WORKSPACE,
            "swm-plan depends on swm-core",
        );
        reports(&TEXT.replace("| `swm-plan` | solvers | `swm-core` |\n", ""), WORKSPACE, "the table lacks swm-plan");
        reports(&TEXT.replace("`clap`", "`swm-raster`"), WORKSPACE, "depend on swm-raster, which is no crate");
        reports(
            &TEXT.replace("| `swm` |", "| `swm-plan` | again | `swm-core` |\n| `swm` |"),
            WORKSPACE,
            "swm-plan twice",
        );
        reports(TEXT, &[("swm-core", &[]), ("swm", &[]), ("swm-plan", &[]), ("xtask", &[])], "the table lacks xtask");
        let without = |name: &str| check(TEXT, &[("swm-core", &[]), (name, &[])]);
        assert!(without("swm").iter().any(|line| line.contains("lists swm-plan, which is no crate")));
    }

    #[test]
    fn a_text_without_the_table_is_an_error() {
        assert!(parse("# Map\n").is_err());
        assert!(parse(&TEXT.replace("| `swm-plan` | solvers |", "| `swm-plan` |")).is_err());
        assert!(parse(&TEXT.replace("`swm-plan` | solvers", "swm-plan | solvers")).is_err());
    }
}
