//! Attention: few tokens that are compared as they are, and many tokens with keys and values.

use super::functions::{add_scaled, dot, exp};
use super::grown;
use super::simd::{Kernel, Level, dispatch};

/// Replaces what every head of some rows asks, in terms of tokens, by what it sees of the tokens: their mean, weighted
/// by the softmax of the scalar products. A row sees its own token and those before it.
///
/// # Shapes
/// `asked` is `[rows, heads, dim]`; `tokens` is `[tokens, samples, dim]`, of which row `i` of `asked` is row
/// `first + i`.
pub(crate) fn attend(
    asked: &mut [f32],
    tokens: &[f32],
    first: usize,
    [samples, dim, heads]: [usize; 3],
    scores: &mut Vec<f32>,
) {
    let window = tokens.len() / (samples * dim);
    dispatch(Few { asked, tokens, first, samples, dim, heads, scores: grown(scores, (window + 1) * heads) });
}

struct Few<'a> {
    asked: &'a mut [f32],
    tokens: &'a [f32],
    first: usize,
    samples: usize,
    dim: usize,
    heads: usize,
    scores: &'a mut [f32],
}

impl Kernel for Few<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let Self { asked, tokens, first, samples, dim, heads, scores } = self;
        // By token, so that the softmax works on all heads at once.
        let (most, scores) = scores.split_at_mut(heads);
        for (index, asked) in asked.chunks_exact_mut(heads * dim).enumerate() {
            let (last, sample) = ((first + index) / samples, (first + index) % samples);
            let token = |at: usize| &tokens[(at * samples + sample) * dim..][..dim];
            most.fill(f32::NEG_INFINITY);
            for at in 0..=last {
                let (token, scores) = (token(at), &mut scores[at * heads..][..heads]);
                for ((asked, score), most) in asked.chunks_exact(dim).zip(scores).zip(most.iter_mut()) {
                    *score = dot::<L>(asked, token);
                    *most = most.max(*score);
                }
            }
            let scores = &mut scores[..(last + 1) * heads];
            for scores in scores.chunks_exact_mut(heads) {
                for (score, most) in scores.iter_mut().zip(most.iter()) {
                    *score = exp::<L>(*score - most);
                }
            }
            // From here on, the sums.
            most.fill(0.0);
            for scores in scores.chunks_exact(heads) {
                for (sum, score) in most.iter_mut().zip(scores) {
                    *sum += score;
                }
            }
            for scores in scores.chunks_exact_mut(heads) {
                for (score, sum) in scores.iter_mut().zip(most.iter()) {
                    *score /= sum;
                }
            }
            asked.fill(0.0);
            for at in 0..=last {
                let (token, scores) = (token(at), &scores[at * heads..][..heads]);
                for (seen, score) in asked.chunks_exact_mut(dim).zip(scores) {
                    add_scaled::<L>(seen, *score, token);
                }
            }
        }
    }
}
