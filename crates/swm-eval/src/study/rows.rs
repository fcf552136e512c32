//! The rows of a study's table.

use super::cell::{Cell, Study};
use super::folder::StudyFolder;
use std::collections::{BTreeMap, BTreeSet};
use swm_core::results::{
    BreakingPoint, ByDisplacement, Comparing, ErrorAndSuccess, Family, OverSeeds, Paired, PlayedErrors, Proportion,
    Ray, Run, StudyResults, StudyRow, Until,
};
use swm_core::{Result, Results};

impl Study {
    /// Returns the outcomes of all cells that are done.
    ///
    /// # Errors
    /// When results are damaged.
    pub fn results(&self, folder: &StudyFolder) -> Result<StudyResults> {
        let mut done: Vec<(&Cell, Results)> = vec![];
        for cell in &self.cells {
            if let Some(results) = folder.results(cell)? {
                done.push((cell, results));
            }
        }
        let (distances, mut found) = (folder.image_distances()?, self.tabulate(&done)?);
        for row in &mut found.rows {
            row.image_distance = distances.get(&row.cell).map(|distance| distance.mean);
        }
        Ok(StudyResults { registration: folder.registration(self)?, ..found })
    }

    /// Returns the outcomes of some cells, without the registration.
    pub(super) fn tabulate(&self, done: &[(&Cell, Results)]) -> Result<StudyResults> {
        let (unshifted, variables) = (self.unshifted(), self.common_variables());
        let of_unshifted = done.iter().filter(|(cell, _)| cell.condition() == unshifted);
        let unshifted_runs: BTreeMap<String, Option<&Run>> = of_unshifted
            .map(|(cell, results)| (key(cell, &variables), runs(cell, results).map(|(run, _)| run)))
            .collect();
        let mut rows = vec![];
        for (cell, results) in done {
            let Some((run, floor)) = runs(cell, results) else { continue };
            let reference = unshifted_runs.get(&key(cell, &variables)).copied().flatten();
            let reference = reference.filter(|_| cell.condition() != unshifted);
            let rate = |p: &Proportion| match self.until {
                None => *p,
                Some(_) => Proportion::sequential(p.successes, p.n),
            };
            rows.push(StudyRow {
                cell: cell.id()?,
                starts: cell.starts.clone(),
                condition: cell.condition().to_owned(),
                variables: cell.variables.clone(),
                policy: cell.policy().to_owned(),
                any_seed: cell.any_seed.clone(),
                counting: results.counting,
                seed: cell.request.seed,
                success: rate(&run.success),
                solved_at_start: run.solved_at_start,
                floor: rate(&floor),
                gap: reference.and_then(|reference| self.comparing()(run, reference, results.counting)),
                trained_on_starts: cell.trained_on_starts,
                image_distance: None,
                // Their intervals hold for a number of episodes that is fixed in advance.
                prediction: run.prediction.as_ref().filter(|_| self.until.is_none()).map(ErrorAndSuccess::of),
                played: self.until.is_none().then(|| played(run)).flatten(),
                by_displacement: if self.until.is_none() { by_displacement(run) } else { vec![] },
            });
        }
        let families = self.correct(&mut rows)?;
        // The spread over training seeds would be that of a fixed number of episodes.
        let over_seeds = if self.until.is_some() { vec![] } else { OverSeeds::all(&rows, unshifted) };
        let open = self.until.map_or(0, |until| self.open(until, &rows, done).len());
        Ok(StudyResults {
            title: self.title.clone(),
            question: self.question.clone(),
            hash: self.hash()?,
            cells: self.cells.len(),
            done: done.len() - open,
            rows,
            families,
            over_seeds,
            until: self.until,
            breaking: self.breaking(done),
            registration: None,
        })
    }

    /// Corrects the gaps of the rows for the number of comparisons in their families, with those of cells that are not
    /// done yet: a verdict does not change while the study goes on.
    fn correct(&self, rows: &mut [StudyRow]) -> Result<Vec<Family>> {
        let (unshifted, variables) = (self.unshifted(), self.common_variables());
        let mut gaps: BTreeMap<String, Option<&mut Paired>> =
            rows.iter_mut().map(|row| (row.cell.clone(), row.gap.as_mut())).collect();
        // Whether the unshifted cell of a comparison is done.
        let mut references: BTreeMap<String, bool> = BTreeMap::new();
        for cell in self.cells.iter().filter(|cell| cell.condition() == unshifted) {
            references.insert(key(cell, &variables), gaps.contains_key(&cell.id()?));
        }
        let mut families: BTreeMap<String, (usize, Vec<&mut Paired>)> = BTreeMap::new();
        for cell in self.cells.iter().filter(|cell| cell.condition() != unshifted) {
            let (Some(reference), gap) = (references.get(&key(cell, &variables)), gaps.remove(&cell.id()?)) else {
                continue;
            };
            if *reference && matches!(gap, Some(None)) {
                // Both are done and have different starts: there is nothing to compare.
                continue;
            }
            let (comparisons, tables) = families.entry(cell.family(&self.families)).or_default();
            *comparisons += 1;
            tables.extend(gap.flatten());
        }
        // Which levels of a ray are evaluated depends on outcomes.
        let possible = if self.ray.is_some() { Ray::LEVELS } else { 0 };
        let corrected = |(name, (comparisons, mut tables)): (String, (usize, Vec<&mut Paired>))| {
            Family::correct(&name, &mut tables, comparisons.max(possible))
        };
        Ok(families.into_iter().filter_map(corrected).collect())
    }

    /// The comparison of two runs.
    fn comparing(&self) -> Comparing {
        if self.until.is_some() { Paired::sequential } else { Paired::of_runs }
    }

    /// Where success breaks, for each unshifted cell.
    fn breaking(&self, done: &[(&Cell, Results)]) -> Vec<BreakingPoint> {
        let (Some(ray), variables) = (&self.ray, self.common_variables()) else { return vec![] };
        let is_unshifted = |cell: &Cell| cell.condition() == self.unshifted();
        let point = |(unshifted, results): &(&Cell, Results)| {
            let same = |cell: &Cell| !is_unshifted(cell) && key(cell, &variables) == key(unshifted, &variables);
            let levels = done.iter().filter(|(cell, _)| same(cell)).enumerate().filter_map(|(i, (cell, results))| {
                let change = cell.variables.get(Ray::VARIABLE).and_then(|change| change.parse().ok());
                Some((change.unwrap_or(i as f64), runs(cell, results)?.0))
            });
            let (run, _) = runs(unshifted, results)?;
            BreakingPoint::of(ray, run, &levels.collect::<Vec<_>>(), results.counting, self.comparing())
        };
        done.iter().filter(|(cell, _)| is_unshifted(cell)).filter_map(point).collect()
    }

    /// The ids of the cells that need more episodes by the rule and have fewer than their requests: those whose rows do not
    /// meet it, and, for a rule of gaps, the unshifted cells that these are compared with.
    pub(super) fn open(&self, until: Until, rows: &[StudyRow], done: &[(&Cell, Results)]) -> BTreeSet<String> {
        let variables = self.common_variables();
        let unmet: BTreeSet<&str> = rows.iter().filter(|row| !until.is_met(row)).map(|row| row.cell.as_str()).collect();
        let with_ids = || done.iter().filter_map(|(cell, results)| Some((cell, results, cell.id().ok()?)));
        let compared: BTreeSet<String> = match until {
            Until::Width(_) => BTreeSet::new(),
            Until::Decided(_) => with_ids()
                .filter(|(_, _, id)| unmet.contains(id.as_str()))
                .map(|(cell, ..)| key(cell, &variables))
                .collect(),
        };
        let is_reference =
            |cell: &Cell| cell.condition() == self.unshifted() && compared.contains(&key(cell, &variables));
        let is_short = |cell: &Cell, results: &Results| {
            results.runs.first().is_some_and(|run| run.episodes.len() < cell.request.episodes)
        };
        with_ids()
            .filter(|(cell, results, id)| {
                is_short(cell, results) && (unmet.contains(id.as_str()) || is_reference(cell))
            })
            .map(|(.., id)| id)
            .collect()
    }

    /// The name of the first condition, which is not shifted.
    pub(super) fn unshifted(&self) -> &str {
        self.cells.first().map_or("", Cell::condition)
    }

    /// The variables that do not belong to the conditions: those with the same values in the unshifted cells as in all.
    pub(super) fn common_variables(&self) -> BTreeSet<&str> {
        let values = |only_unshifted: bool| {
            let mut values: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
            for cell in self.cells.iter().filter(|cell| !only_unshifted || cell.condition() == self.unshifted()) {
                for (name, value) in &cell.variables {
                    values.entry(name).or_default().insert(value);
                }
            }
            values
        };
        let (unshifted, mut all) = (values(true), values(false));
        all.retain(|name, values| unshifted.get(name) == Some(values));
        all.into_keys().collect()
    }
}

/// The run of the cell's policy, and the success rate of the random-policy floor.
fn runs<'a>(cell: &Cell, results: &'a Results) -> Option<(&'a Run, Proportion)> {
    let run = |name: &str| results.runs.iter().find(|run| run.policy == name);
    let floor = results.runs.first()?.success;
    Some((run(cell.policy())?, floor))
}

/// What cells that differ in the condition only have in common. `variables` are those that no condition has.
pub(super) fn key(cell: &Cell, variables: &BTreeSet<&str>) -> String {
    let request = &cell.request;
    let common: Vec<_> = cell.variables.iter().filter(|(name, _)| variables.contains(name.as_str())).collect();
    let names = (&cell.starts, cell.policy(), common);
    format!("{:?}", (names, request.seed, request.planning_seed, request.episodes, request.budget, request.counting))
}

/// The errors for near and for far goals.
fn by_displacement(run: &Run) -> Vec<ByDisplacement> {
    run.prediction.as_ref().zip(run.played.as_ref()).map_or(vec![], |(of, played)| ByDisplacement::of(of, played))
}

/// The errors along the trajectories that the policy played, in the unit of those along the recorded ones.
fn played(run: &Run) -> Option<PlayedErrors> {
    Some(PlayedErrors::of(run.played.as_ref()?, run.prediction.as_ref()?.variance))
}
