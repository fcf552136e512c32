//! How many threads one environment may use: more than one where there are fewer environments than threads.
//!
//! Work goes to environments first ([`crate::EnvPool`]). What is left over may draw parts of one picture; whoever can use it asks
//! for [`threads`], and does its parts by `rayon`, in the pool it runs in. What comes out must not depend on the answer.

use std::cell::Cell;

thread_local! {
    static THREADS: Cell<usize> = const { Cell::new(1) };
}

/// How many threads the present work may use, with that which asks: 1 unless somebody said otherwise.
pub fn threads() -> usize {
    THREADS.get()
}

/// Does work that may use so many threads.
pub fn with<T>(threads: usize, work: impl FnOnce() -> T) -> T {
    /// Puts back what was, also when the work panics.
    struct Back(usize);
    impl Drop for Back {
        fn drop(&mut self) {
            THREADS.set(self.0);
        }
    }
    let _back = Back(THREADS.replace(threads));
    work()
}

/// Does work that may use all threads of the pool it runs in; outside of any, those of the machine.
pub fn all<T>(work: impl FnOnce() -> T) -> T {
    with(rayon::current_num_threads(), work)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_ends_with_its_work() {
        let seen = with(3, || (threads(), with(2, threads), threads()));
        assert_eq!((seen, threads()), ((3, 2, 3), 1));
        assert!(std::panic::catch_unwind(|| with(5, || panic!("as a test"))).is_err());
        assert_eq!(threads(), 1);
    }

    #[test]
    fn all_are_those_of_the_pool() {
        let pool = crate::pool::threads(3).expect("threads");
        assert_eq!(pool.install(|| all(threads)), 3);
    }
}
