//! Primitives that the compiler vectorizes. They are inlined into functions that are compiled once per instruction set.

/// Compiles a function once per instruction set and picks the best one at run time, so that a portable build runs
/// at native speed. `without AVX-512:` before the function leaves that set out.
macro_rules! dispatched {
    (without AVX-512: $($function:tt)*) => {
        $crate::simd::versions! { ["x86_64+avx2+fma+bmi1+bmi2+lzcnt+popcnt"] $($function)* }
    };
    ($($function:tt)*) => {
        $crate::simd::versions! {
            [
                "x86_64+avx512f+avx512bw+avx512cd+avx512dq+avx512vl+avx512vbmi2+avx2+fma+bmi1+bmi2+lzcnt+popcnt",
                "x86_64+avx2+fma+bmi1+bmi2+lzcnt+popcnt"
            ]
            $($function)*
        }
    };
}
pub(super) use dispatched;

#[cfg(not(test))]
macro_rules! versions {
    ([$($target:tt),*] $($function:tt)*) => {
        #[multiversion::multiversion(targets($($target),*))]
        $($function)*
    };
}
/// In unit tests, [`tests::LEVEL`] of the thread chooses the instruction set.
#[cfg(test)]
macro_rules! versions {
    ([$($target:tt),*] $(#[$attribute:meta])* $visibility:vis fn $name:ident($($argument:ident: $type:ty),* $(,)?)
        $(-> $result:ty)? { $($body:tt)* }) => {
        $(#[$attribute])*
        $visibility fn $name($($argument: $type),*) $(-> $result)? {
            #[multiversion::multiversion(targets($($target),*))]
            fn best($($argument: $type),*) $(-> $result)? { $($body)* }
            #[multiversion::multiversion(targets("x86_64+avx2+fma+bmi1+bmi2+lzcnt+popcnt"))]
            fn avx2($($argument: $type),*) $(-> $result)? { $($body)* }
            // All aarch64 processors have NEON, so this is the version without extensions on every architecture.
            #[multiversion::multiversion(targets("aarch64+neon"))]
            fn baseline($($argument: $type),*) $(-> $result)? { $($body)* }

            match $crate::simd::tests::LEVEL.get() {
                $crate::simd::tests::Level::Best => best($($argument),*),
                $crate::simd::tests::Level::Avx2 => avx2($($argument),*),
                $crate::simd::tests::Level::Baseline => baseline($($argument),*),
            }
        }
    };
}
pub(super) use versions;

/// Number of points that are evaluated together: one AVX-512 vector, or two AVX vectors.
pub(super) const LANES: usize = 16;

/// Returns the lowest and highest of a vector's lanes.
#[inline(always)]
pub(super) fn extent(lanes: &[f32; LANES]) -> [f32; 2] {
    let (mut lo, mut hi) = (*lanes, *lanes);
    let mut half = LANES / 2;
    while half > 0 {
        for i in 0..half {
            lo[i] = if lo[i] < lo[i + half] { lo[i] } else { lo[i + half] };
            hi[i] = if hi[i] > hi[i + half] { hi[i] } else { hi[i + half] };
        }
        half /= 2;
    }
    [lo[0], hi[0]]
}

/// `a·b + c`, fused where the target has the instruction. Without it `mul_add` is a slow library call.
#[inline(always)]
pub(super) fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Returns 2ˣ for x in [−126, 126], with a relative error below 3e-7. Rounds to the nearest integer, then evaluates a
/// minimax polynomial of degree 5 on [−½, ½] (coefficients by weighted least squares).
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

/// Names the arithmetic that determines the last bits of results on this processor: the system and architecture, whose
/// mathematical functions differ, and fused or not. The width of vectors does not matter.
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
pub(super) mod tests {
    use std::cell::Cell;

    use super::*;
    use crate::lattice::Lattice;
    use crate::occupancy::Occupancy;
    use crate::{
        Backend as _, Control, CpuBackend, Measures, Spheres, SurfaceKind, SurfaceLimits, SurfaceOptions,
        SurfaceParams, Validation,
    };

    /// Instruction set of the dispatched functions.
    #[derive(Debug, Clone, Copy)]
    pub(crate) enum Level {
        /// The best of this processor.
        Best,
        /// AVX2 on x86-64 with AVX2, else [`Self::Baseline`].
        Avx2,
        /// Instructions that every processor of the architecture has.
        Baseline,
    }

    thread_local! {
        /// Level of the dispatched functions that this thread calls.
        pub(in crate) static LEVEL: Cell<Level> = const { Cell::new(Level::Best) };
    }

    /// Returns the arithmetic of a level and the results of all stages as text, which distinguishes all numbers.
    fn results(level: Level, spheres: &Spheres, limits: &SurfaceLimits) -> (String, Vec<String>) {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).start_handler(move |_| LEVEL.set(level));
        let run = |surface| {
            let options =
                SurfaceOptions { surface: Some(surface), resolution: Some(0.7), atom_ids: true, ..Default::default() };
            let (params, control) = (SurfaceParams::new(&options).unwrap(), Control::default());
            let output = CpuBackend::default().run(spheres, &params, limits, &control).unwrap();
            let measures = Measures::of(&output.mesh, Validation::Checksum, &control).unwrap();
            let occupancy =
                Occupancy::new(&Lattice::new(spheres, &params, &control).unwrap(), limits, &control).unwrap();
            format!("{output:?}\n{measures:?}\n{occupancy:?}")
        };
        pool.build().unwrap().install(|| (arithmetic(), SurfaceKind::ALL.into_iter().map(run).collect()))
    }

    #[test]
    fn instruction_sets_of_one_arithmetic_give_the_same_bytes() {
        // Overlapping spheres at irregular positions, and some at grid points.
        let column = |factor: f64| (0..400).map(|i| f64::from(i) * factor % 23.0).collect();
        let radii = (0..400_u16).map(|i| 1.0 + f32::from(i % 7) / 8.0).collect();
        let spheres = Spheres::new(column(7.13), column(3.71), column(1.4), radii).unwrap();
        let limits = SurfaceLimits::default();
        let [best, avx2, baseline] =
            [Level::Best, Level::Avx2, Level::Baseline].map(|level| results(level, &spheres, &limits));
        for level in [&avx2, &baseline] {
            // The numbers of classes differ in their last bits, so the forced level was used.
            assert_eq!(level.0 == best.0, level.1 == best.1, "{} and {}", level.0, best.0);
        }
        let [fused, least] = [&best, &baseline].map(|(arithmetic, _)| arithmetic.ends_with(" fma"));
        assert_eq!(fused, is_fused());
        assert_eq!(least, cfg!(any(target_feature = "fma", target_arch = "aarch64")), "{}", baseline.0);
    }

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
