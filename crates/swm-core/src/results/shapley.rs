//! [`Game`]: Shapley values of cooperative games in which some players may join only after others.
//!
//! The Shapley value of a player is its mean marginal value over all admissible orders, in which no player precedes one that
//! it comes after (Faigle and Kern, "The Shapley value for cooperative games under precedence constraints", 1992). The values
//! of all players sum to the value of all minus that of none. Without constraints these are Shapley's values of 1953.

/// A set of players: player i is the bit 1 << i.
pub type Coalition = usize;

/// The players of a game, and who comes after whom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Game {
    /// For each player, those that must have joined before it.
    after: Vec<Coalition>,
}

impl Game {
    /// A game in which player i joins only after the players `after[i]`. There are at most 16 players, and none comes after
    /// itself, also not through others; otherwise no order is admissible, and all values are 0.
    pub fn new(after: Vec<Coalition>) -> Self {
        Self { after }
    }

    /// The number of players.
    pub fn players(&self) -> usize {
        self.after.len()
    }

    /// All players.
    pub fn all(&self) -> Coalition {
        (1 << self.players()) - 1
    }

    /// The coalitions that occur in admissible orders, each with all players that its members come after; the empty one
    /// first, the one of all players last.
    pub fn coalitions(&self) -> Vec<Coalition> {
        (0..=self.all()).filter(|&coalition| self.is_admissible(coalition)).collect()
    }

    fn is_admissible(&self, coalition: Coalition) -> bool {
        (0..self.players()).all(|i| coalition & (1 << i) == 0 || self.after[i] & !coalition == 0)
    }

    /// The marginal values whose weighted sum is the Shapley value of each player: the coalitions before and after it joins,
    /// and the share of admissible orders in which it joins there.
    pub fn marginals(&self) -> Vec<Vec<(Coalition, Coalition, f64)>> {
        let joins = |coalition: Coalition, player: usize| {
            let joined = coalition | (1 << player);
            (joined != coalition && self.is_admissible(joined)).then_some(joined)
        };
        let coalitions = self.coalitions();
        // The numbers of orders in which the players of a coalition, or those outside it, can join one by one.
        let (mut inside, mut outside) = (vec![0.0; 1 << self.players()], vec![0.0; 1 << self.players()]);
        inside[0] = 1.0;
        outside[self.all()] = 1.0;
        for &coalition in &coalitions {
            for joined in (0..self.players()).filter_map(|player| joins(coalition, player)) {
                inside[joined] += inside[coalition];
            }
        }
        for &coalition in coalitions.iter().rev() {
            for joined in (0..self.players()).filter_map(|player| joins(coalition, player)) {
                outside[coalition] += outside[joined];
            }
        }
        let orders: f64 = outside[0];
        let of_player = |player: usize| {
            let joined = coalitions.iter().filter_map(|&before| Some((before, joins(before, player)?)));
            let weighted = joined.map(|(before, after)| (before, after, inside[before] * outside[after] / orders));
            weighted.filter(|(.., share)| *share > 0.0).collect()
        };
        (0..self.players()).map(of_player).collect()
    }

    /// The Shapley value of each player, given the value of each coalition of [`Game::coalitions`].
    pub fn shapley(&self, value: impl Fn(Coalition) -> f64) -> Vec<f64> {
        let of_player = |marginals: Vec<(Coalition, Coalition, f64)>| {
            marginals.into_iter().map(|(before, after, share)| share * (value(after) - value(before))).sum()
        };
        self.marginals().into_iter().map(of_player).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;
    use rand::Rng as _;

    fn assert_near(found: &[f64], expected: &[f64]) {
        let near = found.len() == expected.len() && found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near, "{found:?}, not {expected:?}");
    }

    #[test]
    fn values_of_games_with_a_known_solution() {
        let free = Game::new(vec![0; 3]);
        assert_eq!(free.coalitions(), [0, 1, 2, 3, 4, 5, 6, 7]);
        // One left glove and two right ones: a pair is worth 1.
        assert_near(
            &free.shapley(|c| if c & 1 != 0 && c & 6 != 0 { 1.0 } else { 0.0 }),
            &[2.0 / 3.0, 1.0 / 6.0, 1.0 / 6.0],
        );
        // An airport whose runway costs 1, 2 or 3: each part is paid in equal shares by those that use it.
        let length = |c: Coalition| f64::from(usize::BITS - c.leading_zeros());
        assert_near(&free.shapley(length), &[1.0 / 3.0, 1.0 / 3.0 + 0.5, 1.0 / 3.0 + 0.5 + 1.0]);
        // Votes of 49, 49 and 2 with a majority of 51: all have the same power.
        let votes =
            |c: Coalition| [49, 49, 2].iter().enumerate().map(|(i, v)| if c & (1 << i) != 0 { *v } else { 0 }).sum();
        assert_near(&free.shapley(|c| if 50 < votes(c) { 1.0 } else { 0.0 }), &[1.0 / 3.0; 3]);
        assert_near(&free.shapley(|c| [0.0, 5.0, -2.0, 3.0, 0.5, 5.5, -1.5, 3.5][c]), &[5.0, -2.0, 0.5]);
    }

    #[test]
    fn players_join_only_after_those_that_they_come_after() {
        // The third player comes after the second: the orders are 012, 102 and 120.
        let game = Game::new(vec![0, 0, 0b010]);
        assert_eq!(game.coalitions(), [0b000, 0b001, 0b010, 0b011, 0b110, 0b111]);
        let value = |c: Coalition| [0.0, 2.0, 3.0, 7.0, f64::NAN, f64::NAN, 11.0, 20.0][c];
        let expected = [(2.0 + 4.0 + 9.0) / 3.0, (5.0 + 3.0 + 3.0) / 3.0, (13.0 + 13.0 + 8.0) / 3.0];
        assert_near(&game.shapley(value), &expected);
        let chain = Game::new(vec![0, 0b001, 0b011]);
        assert_near(&chain.shapley(|c| [0.0, 1.0, 9.0, 5.0, 9.0, 9.0, 9.0, 7.0][c]), &[1.0, 4.0, 2.0]);
        let circle = Game::new(vec![0b10, 0b01]);
        assert_eq!((circle.coalitions(), circle.shapley(|c| c as f64)), (vec![0, 3], vec![0.0, 0.0]));
    }

    #[test]
    fn values_sum_to_that_of_all_players_and_treat_equal_players_alike() {
        let mut rng = Key::new(4).with("games").rng();
        for after in [vec![0; 5], vec![0, 0, 0, 0, 0b01100], vec![0, 0, 0b1, 0b1, 0b1100]] {
            let game = Game::new(after);
            let values: Vec<f64> = (0..32).map(|_| rng.random_range(-1.0..1.0)).collect();
            let shapley = game.shapley(|c| values[c]);
            assert!((shapley.iter().sum::<f64>() - (values[31] - values[0])).abs() < 1e-12, "{shapley:?}");
            // Players 0 and 1 are interchangeable where only their number counts, and a player that adds nothing gets nothing.
            let shapley = game.shapley(|c| f64::from((c & 0b00011).count_ones()).powi(2));
            let alike = game.after.iter().all(|before| (before & 0b01 == 0) == (before & 0b10 == 0));
            assert!(!alike || (shapley[0] - shapley[1]).abs() < 1e-12, "{shapley:?}");
            assert!(shapley[2..].iter().all(|value| value.abs() < 1e-12), "{shapley:?}");
        }
    }
}
