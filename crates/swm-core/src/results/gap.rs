//! [`Gap`]: what a shift costs a policy, within one evaluation.

use super::{Family, Paired, Results, Run};

/// The success rate of a policy under a condition minus that under the first condition, on the same starts.
#[derive(Clone, Debug, PartialEq)]
pub struct Gap {
    /// The condition.
    pub condition: String,
    /// The policy.
    pub policy: String,
    /// The outcomes of all starts that count under both conditions.
    pub table: Paired,
}

impl Results {
    /// Returns the gap of every condition to the first one, for each policy, and the families: the gaps of one policy form
    /// a family. Conditions with other starts have no gap.
    pub fn gaps(&self) -> (Vec<Gap>, Vec<Family>) {
        let Some(first) = self.runs.first().map(|run| &run.condition) else { return (vec![], vec![]) };
        let (mut all, mut families) = (vec![], vec![]);
        for reference in self.runs.iter().filter(|run| run.condition == *first) {
            let others = self.runs.iter().filter(|run| run.policy == reference.policy && run.condition != *first);
            let gap = |run: &Run| {
                let table = self.comparing()(run, reference, self.counting)?;
                Some(Gap { condition: run.condition.clone(), policy: run.policy.clone(), table })
            };
            let mut gaps: Vec<Gap> = others.filter_map(gap).collect();
            let mut tables: Vec<&mut Paired> = gaps.iter_mut().map(|gap| &mut gap.table).collect();
            families.extend(Family::correct(&reference.policy, &mut tables, 0));
            all.extend(gaps);
        }
        (all, families)
    }
}
