//! Distances of vertices from the isosurface of every kernel, on a protein. This file computes the densities itself,
//! over all atoms and in double precision.

#![expect(clippy::unwrap_used, reason = "tests fail by panicking")]

use std::path::Path;

use molmesh::structure::{self, ReadLimits, Selection};
use molmesh::surface::{
    Backend, Control, CpuBackend, Kernel, Mesh, ReferenceBackend, Spheres, SurfaceLimits, SurfaceOptions, SurfaceParams,
};

const KERNELS: [Kernel; 3] = [Kernel::Gaussian, Kernel::SoftObject, Kernel::InverseSquare];

/// Ends of the edges of a grid, as far as vertices come to them.
const MARGIN: f64 = 1.0 / 1024.0;

fn ubiquitin() -> Spheres {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/structures/1ubq.pdb.gz");
    let read = structure::read(&std::fs::read(path).unwrap(), &ReadLimits::default()).unwrap();
    structure::select(&read, &Selection::default()).unwrap().spheres(&read).unwrap()
}

/// The first `n` spheres.
fn first(spheres: &Spheres, n: usize) -> Spheres {
    let column = |k: usize| (0..n).map(|i| spheres.centre(i)[k]).collect();
    Spheres::new(column(0), column(1), column(2), (0..n).map(|i| spheres.radius(i)).collect()).unwrap()
}

fn mesh(backend: &dyn Backend, spheres: &Spheres, kernel: Kernel, resolution: f64) -> Mesh {
    let options =
        SurfaceOptions { surface: Some(kernel.into()), resolution: Some(resolution), ..SurfaceOptions::default() };
    let params = SurfaceParams::new(&options).unwrap();
    backend.run(spheres, &params, &SurfaceLimits::default(), &Control::default()).unwrap().mesh
}

/// Density of an atom and its derivative at u = d²/r², with the default parameters: the formulas of docs/surface.md.
fn kernel_at(kernel: Kernel, u: f64) -> (f64, f64) {
    let s = u / 4.0;
    match kernel {
        Kernel::Gaussian => {
            let (a, e) = (1.25, 0.01_f64);
            let end = 1.0 + (1.0 / e).ln() / a;
            let (bell, norm) = ((-a * (u - 1.0)).exp(), 1.0 - e * (1.0 + (1.0 / e).ln()));
            if u < end { ((bell - e * (1.0 + a * (end - u))) / norm, a * (e - bell) / norm) } else { (0.0, 0.0) }
        }
        Kernel::SoftObject if s < 1.0 => {
            let norm = 8.0 / 9.0 * 9.0 / 16.0;
            let slope = -4.0 / 9.0 * (1.0 - s).powi(2) - 2.0 * (1.0 - 4.0 / 9.0 * s) * (1.0 - s);
            ((1.0 - 4.0 / 9.0 * s) * (1.0 - s).powi(2) / norm, slope / (4.0 * norm))
        }
        Kernel::InverseSquare if s < 1.0 => {
            let norm = 9.0 / 4.0;
            ((1.0 - s).powi(2) / s / norm, (1.0 - 1.0 / (s * s)) / (4.0 * norm))
        }
        _ => (0.0, 0.0),
    }
}

/// A sum of densities.
struct Densities {
    kernel: Kernel,
    atoms: Vec<([f64; 3], f64)>,
}

impl Densities {
    fn new(spheres: &Spheres, kernel: Kernel) -> Self {
        let atoms = (0..spheres.len()).map(|i| (spheres.centre(i), f64::from(spheres.radius(i)))).collect();
        Self { kernel, atoms }
    }

    /// Density and gradient, per Å.
    fn at(&self, x: [f64; 3]) -> (f64, [f64; 3]) {
        let (mut value, mut gradient) = (0.0, [0.0; 3]);
        for (centre, radius) in &self.atoms {
            let d: [f64; 3] = std::array::from_fn(|k| x[k] - centre[k]);
            let (f, slope) = kernel_at(self.kernel, d.iter().map(|d| d * d).sum::<f64>() / (radius * radius));
            value += f;
            (0..3).for_each(|k| gradient[k] += 2.0 * slope * d[k] / (radius * radius));
        }
        (value, gradient)
    }

    /// The same sum without atoms that have no effect near `x`: no atom of a protein reaches 5 Å.
    fn near(&self, x: [f64; 3]) -> Self {
        let near = |(c, _): &&([f64; 3], f64)| (0..3).map(|k| (x[k] - c[k]).powi(2)).sum::<f64>() < 7.0_f64.powi(2);
        Self { kernel: self.kernel, atoms: self.atoms.iter().filter(near).copied().collect() }
    }

    /// Distance from the isosurface at 1, Å: descends along the gradient.
    fn distance(&self, x: [f64; 3]) -> f64 {
        let mut foot = x;
        for _ in 0..30 {
            let (value, g) = self.at(foot);
            let step = value.ln() * value / g.iter().map(|c| c * c).sum::<f64>();
            // No longer than a tenth of an ångström, near points without a gradient.
            let length = step.abs() * g.iter().map(|c| c * c).sum::<f64>().sqrt();
            let step = step * (0.1 / length).min(1.0);
            foot = std::array::from_fn(|k| foot[k] - step * g[k]);
            if length < 1e-6 {
                break;
            }
        }
        (0..3).map(|k| (foot[k] - x[k]).powi(2)).sum::<f64>().sqrt()
    }
}

/// The grid edge of a vertex: its first grid point, in spacings, and its axis.
fn edge_of(lattice: [f64; 3]) -> ([f64; 3], usize) {
    let off = |k: usize| (lattice[k] - lattice[k].round()).abs();
    let axis = (0..3).max_by(|&a, &b| off(a).total_cmp(&off(b))).unwrap();
    (std::array::from_fn(|k| if k == axis { lattice[k].floor() } else { lattice[k].round() }), axis)
}

/// Root mean square and maximum of distances.
fn summary(distances: &[f64]) -> [f64; 2] {
    let n = distances.len();
    #[expect(clippy::cast_precision_loss, reason = "small numbers are exact")]
    let mean = distances.iter().map(|d| d * d).sum::<f64>() / n as f64;
    [mean.sqrt(), distances.iter().copied().fold(0.0, f64::max)]
}

/// Root mean square and maximum of the distances of vertices from the isosurface; and of the points at which linear
/// interpolation of the densities at both ends would place them. Checks the median of the normals' errors.
fn distances(mesh: &Mesh, densities: &Densities, h: f64) -> [[f64; 2]; 2] {
    let (mut own, mut linear) = (Vec::new(), Vec::new());
    let mut turned = Vec::new();
    for (p, n) in mesh.positions.iter().zip(&mesh.normals).step_by(mesh.n_vertices() / 1500) {
        let x: [f64; 3] = std::array::from_fn(|k| f64::from(p[k]) + mesh.centre[k]);
        let densities = densities.near(x);
        own.push(densities.distance(x));
        let (_, g) = densities.at(x);
        let steepness = g.iter().map(|c| c * c).sum::<f64>().sqrt();
        let cosine: f64 = (0..3).map(|k| -g[k] / steepness * f64::from(n[k])).sum();
        turned.push(cosine.min(1.0).acos().to_degrees());
        let (first, axis) = edge_of(x.map(|c| c / h));
        let along = |t: f64| {
            let mut at = first;
            at[axis] += t;
            at.map(|c| c * h)
        };
        let [f0, f1] = [0.0, 1.0].map(|t| densities.at(along(t)).0);
        assert!((f0 - 1.0) * (f1 - 1.0) < 1e-5, "{x:?} is not on a crossing edge: {f0} {f1}");
        linear.push(densities.distance(along(((f0 - 1.0) / (f0 - f1)).clamp(MARGIN, 1.0 - MARGIN))));
    }
    turned.sort_by(f64::total_cmp);
    // Normals belong to the points before the step: most are close, those in creases are not.
    assert!(turned[turned.len() / 2] < 0.4, "half of the normals are off by {}° or more", turned[turned.len() / 2]);
    [summary(&own), summary(&linear)]
}

#[test]
fn vertices_of_a_protein_lie_on_the_isosurface() {
    let whole = ubiquitin();
    // The reference takes long, so it gets a part.
    let part = first(&whole, 150);
    let native = CpuBackend::new(Some(2)).unwrap();
    for kernel in KERNELS {
        let runs: [(&dyn Backend, &Spheres, f64); 3] =
            [(&native, &whole, 0.5), (&native, &whole, 0.25), (&ReferenceBackend, &part, 0.5)];
        for (backend, spheres, h) in runs {
            let mesh = mesh(backend, spheres, kernel, h);
            let [own, linear] = distances(&mesh, &Densities::new(spheres, kernel), h);
            let what = format!("{} {kernel} {h}: {own:?}, linear {linear:?}", backend.name());
            // Root mean square and maximum, Å.
            let bounds = if h > 0.3 { [0.009, 0.25] } else { [0.0015, 0.05] };
            assert!(own[0] < bounds[0] && own[1] < bounds[1], "{what}");
            // Negative control: linear interpolation is farther away.
            assert!(linear[0] > 1.5 * bounds[0], "{what}");
        }
    }
}
