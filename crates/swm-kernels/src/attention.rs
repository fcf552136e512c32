//! Causal attention to a few tokens per sample. Queries are compared with tokens instead of keys, because the caller
//! multiplies queries by the transposed key matrix.

use crate::functions::{add_scaled, dot, exp};
use crate::grown;
use swm_simd::{Kernel, Level, dispatch};

/// Replaces the query of every head, given in the tokens' space, by the head's attention output: the mean of the tokens
/// weighted by the softmax of the scalar products of tokens and query. A row attends to its own token and to
/// earlier tokens of its sample.
///
/// # Shapes
/// `queries` is `[rows, heads, dim]`, `tokens` is `[tokens, samples, dim]`. Row `i` of `queries` belongs to row
/// `first + i` of the `tokens * samples` rows.
pub fn causal_attention(
    queries: &mut [f32],
    tokens: &[f32],
    first: usize,
    [samples, dim, heads]: [usize; 3],
    scores: &mut Vec<f32>,
) {
    let window = tokens.len() / (samples * dim);
    dispatch(CausalAttention {
        queries,
        tokens,
        first,
        samples,
        dim,
        heads,
        scores: grown(scores, (window + 1) * heads),
    });
}

struct CausalAttention<'a> {
    queries: &'a mut [f32],
    tokens: &'a [f32],
    first: usize,
    samples: usize,
    dim: usize,
    heads: usize,
    scores: &'a mut [f32],
}

impl Kernel for CausalAttention<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: Level>(self) {
        let Self { queries, tokens, first, samples, dim, heads, scores } = self;
        // Scores are ordered by token, then by head, so that the softmax works on all heads at once.
        let (maxima, scores) = scores.split_at_mut(heads);
        for (index, query) in queries.chunks_exact_mut(heads * dim).enumerate() {
            let (last, sample) = ((first + index) / samples, (first + index) % samples);
            let token = |key: usize| &tokens[(key * samples + sample) * dim..][..dim];
            maxima.fill(f32::NEG_INFINITY);
            for key in 0..=last {
                let (token, scores) = (token(key), &mut scores[key * heads..][..heads]);
                for ((query, score), max) in query.chunks_exact(dim).zip(scores).zip(maxima.iter_mut()) {
                    *score = dot::<L>(query, token);
                    *max = max.max(*score);
                }
            }
            let scores = &mut scores[..(last + 1) * heads];
            for scores in scores.chunks_exact_mut(heads) {
                for (score, max) in scores.iter_mut().zip(maxima.iter()) {
                    *score = exp::<L>(*score - max);
                }
            }
            let sums = &mut *maxima;
            sums.fill(0.0);
            for scores in scores.chunks_exact(heads) {
                for (sum, score) in sums.iter_mut().zip(scores) {
                    *sum += score;
                }
            }
            for scores in scores.chunks_exact_mut(heads) {
                for (score, sum) in scores.iter_mut().zip(sums.iter()) {
                    *score /= sum;
                }
            }
            query.fill(0.0);
            for key in 0..=last {
                let (token, scores) = (token(key), &scores[key * heads..][..heads]);
                for (mixed, score) in query.chunks_exact_mut(dim).zip(scores) {
                    add_scaled::<L>(mixed, *score, token);
                }
            }
        }
    }
}
