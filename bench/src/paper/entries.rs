//! Tables of Dias, Bora and Gomes (HPDC 2010), and raw kernel parameters.
//!
//! Table 1 (Core 2 Quad Q9550, one thread) and Table 2 (`GeForce` GTX 280) list seconds for each of the three kernels.
//! The paper gives formulas and ranges of the kernel parameters, but no values. Here, the support of an atom is 4 Å,
//! half of the 20 grid points of 0.4 Å that the paper's program visits along each axis. The surface of a single atom
//! has a radius of 1.7 Å.

use molmesh::surface::{Kernel, SurfaceOptions, SurfaceParams};

use crate::error::{Error, Result};

/// Row of both tables, with seconds by kernel in the order of [`KERNELS`].
#[derive(Debug)]
pub(crate) struct Entry {
    /// PDB id.
    pub(crate) id: &'static str,
    /// Number of atoms (ATOM records) according to the paper.
    pub(crate) atoms: usize,
    /// Numbers of cubes on the CPU and on the GPU.
    pub(crate) cubes: [u64; 2],
    pub(crate) cpu: [f64; 3],
    pub(crate) gpu: [f64; 3],
}

/// Kernels in the order of the tables.
pub(crate) const KERNELS: [Kernel; 3] = [Kernel::Gaussian, Kernel::SoftObject, Kernel::InverseSquare];

const fn entry(id: &'static str, atoms: usize, cubes: [u64; 2], cpu: [f64; 3], gpu: [f64; 3]) -> Entry {
    Entry { id, atoms, cubes, cpu, gpu }
}

/// All rows, sorted by atoms.
pub(crate) const ENTRIES: [Entry; 16] = [
    entry("110D", 120, [346_580, 352_000], [0.68, 0.45, 0.43], [0.13, 0.13, 0.13]),
    entry("200D", 259, [603_520, 610_176], [1.90, 1.40, 1.20], [0.27, 0.27, 0.26]),
    entry("1QL1", 322, [1_581_370, 1_600_896], [2.79, 2.14, 1.90], [0.38, 0.37, 0.37]),
    entry("4PTI", 381, [1_043_464, 1_053_440], [4.89, 3.70, 3.00], [0.41, 0.40, 0.40]),
    entry("1BK2", 468, [650_160, 657_920], [4.89, 3.70, 3.00], [0.36, 0.35, 0.35]),
    entry("2QZF", 479, [3_536_664, 3_562_624], [5.55, 4.30, 3.60], [0.88, 0.72, 0.72]),
    entry("2QZD", 507, [3_860_800, 3_901_824], [6.10, 4.70, 4.00], [0.94, 0.93, 0.94]),
    entry("2OT5", 545, [1_154_032, 1_167_360], [6.00, 4.80, 4.14], [0.56, 0.53, 0.51]),
    entry("1HH0", 691, [1_632_000, 1_652_608], [6.40, 5.50, 4.46], [0.73, 0.69, 0.67]),
    entry("1HGV", 691, [1_970_752, 1_994_752], [6.56, 5.50, 4.57], [0.89, 0.74, 0.70]),
    entry("1HGZ", 691, [1_605_760, 1_626_112], [6.30, 5.45, 4.36], [0.68, 0.65, 0.64]),
    entry("2INS", 781, [1_316_250, 1_326_976], [11.10, 9.12, 7.30], [0.84, 0.82, 0.82]),
    entry("1QL2", 966, [4_619_920, 4_654_208], [16.10, 13.90, 11.50], [2.10, 2.10, 2.00]),
    entry("1IZH", 1521, [2_578_680, 2_601_472], [37.40, 31.20, 25.10], [2.40, 2.22, 2.15]),
    entry("1GT0", 2746, [5_681_590, 5_720_832], [102.00, 94.14, 67.87], [7.52, 7.54, 6.90]),
    entry("1BIJ", 4387, [7_229_120, 7_267_456], [250.50, 240.20, 179.10], [15.00, 14.40, 14.20]),
];

/// Returns surface parameters with the raw parameters of a kernel, at a grid spacing in Å.
///
/// # Errors
/// Returns [`Error::Failed`] if the spacing is out of range.
pub(crate) fn surface(kernel: Kernel, spacing: f64) -> Result<SurfaceParams> {
    let (a, b, c, isovalue) = match kernel {
        // 2.75·exp(−0.35·1.7²) is 1; the cut-off of 1 % is reached at 4.0 Å.
        Kernel::Gaussian => (Some(0.35), Some(2.75), None, 1.0),
        // (1 − 4/9 s)(1 − s)² is 1/1.62 at s = (1.7/4)².
        Kernel::SoftObject => (Some(1.62), Some(4.0), None, 1.0),
        // (1 − s)²/1.7² is 0.232.
        Kernel::InverseSquare => (None, Some(4.0), Some(1.0), 0.232),
    };
    let options = SurfaceOptions {
        surface: Some(kernel.into()),
        resolution: Some(spacing),
        isovalue: Some(isovalue),
        paper_a: a,
        paper_b: b,
        paper_c: c,
        ..SurfaceOptions::default()
    };
    SurfaceParams::new(&options).map_err(Error::failed)
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "the numbers must be identical")]
mod tests {
    use super::*;
    use molmesh::surface::kernel::Profile;

    #[test]
    fn tables_have_the_column_sums_of_the_paper() {
        assert_eq!(ENTRIES.len(), 16);
        assert!(ENTRIES.is_sorted_by_key(|e| e.atoms));
        // Sums over the columns of the printed tables.
        let sum = |of: &dyn Fn(&Entry) -> f64| (ENTRIES.iter().map(of).sum::<f64>() * 100.0).round() / 100.0;
        assert_eq!(sum(&|e| e.atoms as f64), 15_555.0);
        let cpu = [0, 1, 2].map(|k| sum(&|e: &Entry| e.cpu[k]));
        let gpu = [0, 1, 2].map(|k| sum(&|e: &Entry| e.gpu[k]));
        assert_eq!(cpu, [469.16, 430.20, 325.53]);
        assert_eq!(gpu, [34.09, 32.86, 31.76]);
        for entry in &ENTRIES {
            let excess = entry.cubes[1] as f64 / entry.cubes[0] as f64;
            assert!((1.0..1.02).contains(&excess), "{}: {excess}", entry.id);
            assert!(entry.cpu.is_sorted_by(|a, b| a >= b), "{}", entry.id);
        }
    }

    #[test]
    fn raw_parameters_give_the_radius_and_support_of_an_atom() {
        for kernel in KERNELS {
            let params = surface(kernel, 0.4).unwrap();
            let profile = Profile::new(kernel, &params);
            let length = profile.length(1.5);
            assert_eq!(length, profile.length(2.0), "radii are not used");
            assert!((profile.reach(length) - 4.0).abs() < 0.02, "{kernel}: {}", profile.reach(length));
            let at = |d: f64| profile.value((d / length).powi(2), 0.0) / params.isovalue;
            assert!((at(1.7) - 1.0).abs() < 0.01 && at(1.6) > 1.05 && at(1.8) < 0.95, "{kernel}: {}", at(1.7));
        }
        assert!(surface(Kernel::Gaussian, 0.0).is_err());
    }
}
