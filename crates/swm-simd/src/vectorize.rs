//! [`vectorize!`](crate::vectorize): functions compiled for the baseline and for AVX2.

/// Defines functions that are compiled for the baseline and for AVX2; a call runs the better version that the CPU
/// supports. Bodies are loops over slices that the compiler turns into vector instructions, and call only functions that
/// are `#[inline(always)]`.
///
/// ```
/// swm_simd::vectorize! {
///     /// Adds `x` to every element.
///     pub fn add(values: &mut [f32], x: f32) {
///         values.iter_mut().for_each(|value| *value += x);
///     }
/// }
/// let mut values = [1.0, 2.0];
/// add(&mut values, 0.5);
/// assert_eq!(values, [1.5, 2.5]);
/// ```
#[macro_export]
macro_rules! vectorize {
    ($($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $type:ty),* $(,)?) $(-> $out:ty)? $body:block)*) => { $(
        $(#[$meta])*
        #[allow(clippy::too_many_arguments, reason = "kernels take slices, not structs of slices")]
        $vis fn $name($($arg: $type),*) $(-> $out)? {
            #[inline(always)]
            fn baseline($($arg: $type),*) $(-> $out)? $body
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2")]
                fn avx2($($arg: $type),*) $(-> $out)? {
                    baseline($($arg),*)
                }
                if $crate::cpu_level() >= $crate::CpuLevel::Avx2 {
                    // SAFETY: the CPU supports AVX2.
                    #[allow(unsafe_code, reason = "calls a function that is compiled for a feature of the CPU")]
                    return unsafe { avx2($($arg),*) };
                }
            }
            baseline($($arg),*)
        }
    )* };
}
