//! The thread budget: the number of threads that one environment may use. The budget exceeds 1 if there are fewer
//! environments than threads.
//!
//! The pool distributes environments over threads first ([`crate::EnvPool`]). A renderer reads [`threads`] and may draw
//! parts of one frame on as many threads of the current rayon pool. The output of a renderer
//! must not depend on the budget.

use std::cell::Cell;

thread_local! {
    static THREADS: Cell<usize> = const { Cell::new(1) };
}

/// The number of threads that the calling code may use, including the current one; 1 unless a caller set a budget.
pub fn threads() -> usize {
    THREADS.get()
}

/// Runs `work` with a budget of `threads` threads.
pub fn with<T>(threads: usize, work: impl FnOnce() -> T) -> T {
    /// Restores the previous budget, also when the work panics.
    struct Restore(usize);
    impl Drop for Restore {
        fn drop(&mut self) {
            THREADS.set(self.0);
        }
    }
    let _restore = Restore(THREADS.replace(threads));
    work()
}

/// Runs `work` with all threads of the current rayon pool as its budget.
pub fn all<T>(work: impl FnOnce() -> T) -> T {
    with(rayon::current_num_threads(), work)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thread_budget_is_restored_after_a_return_and_after_a_panic() {
        let budgets = with(3, || (threads(), with(2, threads), threads()));
        assert_eq!((budgets, threads()), ((3, 2, 3), 1));
        assert!(std::panic::catch_unwind(|| with(5, || panic!("the work fails"))).is_err());
        assert_eq!(threads(), 1);
    }

    #[test]
    fn all_sets_the_budget_to_the_thread_count_of_the_pool() {
        let pool = crate::pool::threads(3).expect("creating the thread pool");
        assert_eq!(pool.install(|| all(threads)), 3);
    }
}
