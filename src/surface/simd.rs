//! SIMD-friendly primitives, inlined into `multiversion` functions, which compile them per instruction set.

/// Compiles a function once per instruction set and picks the best one at run time, so that a portable build runs
/// at native speed.
macro_rules! dispatched {
    ($($function:tt)*) => {
        #[multiversion::multiversion(targets(
            "x86_64+avx512f+avx512bw+avx512cd+avx512dq+avx512vl+avx512vbmi2+avx2+fma+bmi1+bmi2+lzcnt+popcnt",
            "x86_64+avx2+fma+bmi1+bmi2+lzcnt+popcnt",
        ))]
        $($function)*
    };
}
pub(super) use dispatched;

/// `a·b + c`, fused where the target has the instruction. Without it `mul_add` is a slow library call.
#[inline(always)]
pub(super) fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// 2ˣ for x in [−126, 126], relative error below 3e-7: round to nearest, then a minimax polynomial of degree 5 on
/// [−½, ½] (coefficients by weighted least squares).
#[inline(always)]
pub(super) fn exp2<const FMA: bool>(x: f32) -> f32 {
    // Adding 1.5·2²³ leaves the rounded integer in the low bits of the sum.
    const MAGIC: f32 = 12_582_912.0;
    let shifted = x + MAGIC;
    let f = x - (shifted - MAGIC);
    let p = fma::<FMA>(0.001_327_647_2, f, 0.009_675_541);
    let p = fma::<FMA>(p, f, 0.055_507_13);
    let p = fma::<FMA>(p, f, 0.240_221_2);
    let p = fma::<FMA>(p, f, 0.693_146_94);
    let p = fma::<FMA>(p, f, 1.000_000_1);
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

dispatched! {
    /// Returns true if the dispatched functions fuse products and sums on this processor. They use the same condition.
    fn is_fused() -> bool {
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_arch = "aarch64"))
    }
}

/// Returns the name of the arithmetic that decides the last bits of results on this processor: fused or not, and the
/// system and architecture, whose mathematical functions differ. The width of vectors does not matter.
#[must_use]
pub fn arithmetic() -> String {
    let fused = if is_fused() { "fma" } else { "no-fma" };
    format!("{} {} {fused}", std::env::consts::OS, std::env::consts::ARCH)
}

/// The vector extension that the dispatched functions use here, for display.
#[must_use]
pub(super) fn extension() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        if std::arch::is_x86_feature_detected!("avx512f") && std::arch::is_x86_feature_detected!("avx512vbmi2") {
            return "AVX-512";
        }
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
            return "AVX2";
        }
        "SSE2"
    }
    #[cfg(target_arch = "aarch64")]
    {
        "NEON"
    }
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    {
        "scalar"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_arithmetic_matches_the_dispatch() {
        // Both vector extensions have fused multiply-add; plain x86-64 has not.
        assert_eq!(is_fused(), ["AVX-512", "AVX2", "NEON"].contains(&extension()));
        assert!(arithmetic().ends_with(if is_fused() { " fma" } else { " no-fma" }), "{}", arithmetic());
    }

    #[test]
    fn exp2_is_within_three_parts_in_ten_million() {
        for i in -124_000..=124_000 {
            let x = i as f32 / 1000.0;
            let exact = f64::from(x).exp2();
            for got in [exp2::<true>(x), exp2::<false>(x)] {
                assert!((f64::from(got) / exact - 1.0).abs() < 4e-7, "{x}: {got} {exact}");
            }
        }
    }
}
