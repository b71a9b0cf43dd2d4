//! Automatic grid spacing: levels of detail, and a limit on triangles that holds for every structure.

use molmesh::pipeline::spacing::{COARSEST, FINEST};
use molmesh::pipeline::{Choice, Estimate, JobError, JobLimits, Product, Report, estimate, params, run};
use molmesh::structure::{ReadLimits, read_with};
use molmesh::surface::{Control, CpuBackend, Limit, SurfaceError, SurfaceLimits};

const PTI: &[u8] = include_bytes!("../../samples/4pti.pdb");
const CRAMBIN: &[u8] = include_bytes!("../../samples/1crn.cif");

/// Returns one carbon per residue at these positions, Å.
fn carbons(places: impl IntoIterator<Item = [f64; 3]>) -> Vec<u8> {
    let line = |(i, [x, y, z]): (usize, [f64; 3])| {
        let n = i % 9999 + 1;
        format!("ATOM  {n:>5}  CA  ALA A{n:>4}    {x:>8.3}{y:>8.3}{z:>8.3}  1.00  0.00           C  \n")
    };
    places.into_iter().enumerate().map(line).collect::<String>().into_bytes()
}

/// Returns `n`³ carbons on a grid.
fn cube(n: u32, distance: f64) -> Vec<u8> {
    let at = move |i: u32| f64::from(i) * distance;
    carbons((0..n).flat_map(move |x| (0..n).flat_map(move |y| (0..n).map(move |z| [at(x), at(y), at(z)]))))
}

/// Structures of different shapes: compact, hollow, long, scattered, a single atom.
fn structures() -> Vec<(&'static str, Vec<u8>)> {
    vec![
        ("4pti", PTI.to_vec()),
        ("1crn", CRAMBIN.to_vec()),
        ("block", cube(9, 2.0)),
        ("scattered", cube(5, 13.0)),
        ("rod", carbons((0..60).map(|i| [1.5 * f64::from(i), 0.25, -0.75]))),
        ("atom", carbons([[1.0, 2.0, 3.0]])),
    ]
}

fn with(input: &[u8], pairs: &[(&str, &str)], surface: SurfaceLimits) -> Result<Product, JobError> {
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    let backend = CpuBackend::new(None).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    run(input, &options, &JobLimits { surface, ..JobLimits::default() }, &choice, &Control::default(), &(), None)
}

fn product(input: &[u8], pairs: &[(&str, &str)]) -> Result<Product, JobError> {
    with(input, pairs, SurfaceLimits::default())
}

fn report(input: &[u8], pairs: &[(&str, &str)]) -> Report {
    product(input, pairs).unwrap().report
}

fn expected(input: &[u8], pairs: &[(&str, &str)]) -> Estimate {
    let options = params::parse(pairs.iter().copied()).unwrap().options;
    let backend = CpuBackend::new(None).unwrap();
    let choice = Choice { backend: &backend, reason: "set by a test" };
    let read = |control: &Control<'_>| read_with(input, &ReadLimits::default(), control).map(Box::new);
    estimate(read, &options, &JobLimits::default(), &choice, &Control::default()).unwrap()
}

#[test]
fn the_limit_holds_for_every_structure_and_kernel() {
    let (mut fitted, mut finest, mut refused) = (0, 0, 0);
    for (name, input) in structures() {
        for kernel in ["gaussian", "soft-object", "inverse-square"] {
            for limit in [40_u64, 700, 9000, 60_000] {
                let text = limit.to_string();
                let case = format!("{name} {kernel} {limit}");
                let bounded = product(&input, &[("surface", kernel), ("max_triangles", &text)]);
                let Product { mesh, report, .. } = match bounded {
                    Ok(product) => product,
                    Err(JobError::Surface(error)) => {
                        let exceeded = error.exceeded(Limit::Triangles).unwrap_or_else(|| panic!("{case}: {error}"));
                        let (reported, triangles) = (exceeded.max, exceeded.actual.unwrap());
                        let resolution = exceeded.resolution.unwrap();
                        refused += 1;
                        // The error is correct: its spacing gives this number of triangles, and it is the coarsest one
                        // except for separate atoms.
                        assert!(reported == limit && triangles > limit, "{case}: {triangles}");
                        assert!(name == "scattered" || resolution.total_cmp(&COARSEST).is_eq(), "{case}: {resolution}");
                        let text = resolution.to_string();
                        let at_resolution = report(&input, &[("surface", kernel), ("resolution", &text)]);
                        assert_eq!(at_resolution.triangles, triangles, "{case}");
                        continue;
                    }
                    Err(other) => panic!("{case}: {other}"),
                };
                let n = mesh.n_triangles() as u64;
                assert!(n <= limit && n == report.triangles && n > 0, "{case}: {n}");
                assert!(report.closed && report.manifold, "{case}");
                let tries = report.tries.unwrap();
                assert!((1..=8).contains(&tries), "{case}: {tries} tries");
                assert_eq!((report.resolution_from, report.max_triangles), ("max_triangles", Some(limit)));
                assert!((FINEST..=COARSEST).contains(&report.resolution), "{case}: {}", report.resolution);
                if report.resolution > FINEST {
                    fitted += 1;
                    // The mesh uses most of the limit. The triangle counts of small meshes change in larger steps.
                    assert!(n * 10 >= limit * 8 || limit < 1000, "{case}: {n} at {}", report.resolution);
                } else {
                    finest += 1;
                }
                // The same spacing as an explicit parameter gives the same mesh.
                let resolution = report.resolution.to_string();
                let same = product(&input, &[("surface", kernel), ("resolution", &resolution)]).unwrap().mesh;
                assert!(same.positions[..] == mesh.positions[..] && same.triangles[..] == mesh.triangles[..], "{case}");
            }
        }
    }
    assert!(fitted > 20 && finest > 3 && refused > 3, "{fitted} {finest} {refused}");
}

#[test]
fn the_same_limit_gives_the_same_mesh_and_report() {
    let [one, two] = [(); 2].map(|()| product(PTI, &[("max_triangles", "20000")]).unwrap());
    assert_eq!(one.report.extras(), two.report.extras());
    assert!(one.mesh.positions[..] == two.mesh.positions[..]);
    let plain = report(PTI, &[]);
    assert_eq!(
        (plain.resolution_from, plain.tries, plain.detail, plain.max_triangles),
        ("resolution", None, None, None)
    );
    assert_ne!(one.report.extras()["resolution"], plain.extras()["resolution"]);
    assert!(one.report.timings_ms["field"].as_f64().unwrap() > 0.0);
}

#[test]
fn the_other_limits_apply_too() {
    let narrow = SurfaceLimits { max_grid_points: 40_000, ..SurfaceLimits::default() };
    let refused = with(PTI, &[("max_triangles", "1000000")], narrow).unwrap_err();
    assert!(matches!(&refused, JobError::Surface(error) if error.exceeded(Limit::GridPoints).is_some()), "{refused}");
    assert!(with(PTI, &[("max_triangles", "2000")], narrow).is_ok());
    // An isovalue above the maximum fails at any spacing.
    let nothing = product(PTI, &[("max_triangles", "1000"), ("isovalue", "100000")]).unwrap_err();
    assert!(matches!(nothing, JobError::Surface(SurfaceError::NoSurface { .. })), "{nothing}");
}

#[test]
fn levels_of_detail_have_the_documented_spacings() {
    let mut last = 0;
    for (level, resolution) in ["2", "1.4", "1", "0.7", "0.5", "0.35", "0.25"].into_iter().enumerate() {
        let text = level.to_string();
        let by_level = product(PTI, &[("detail", &text)]).unwrap();
        let given = product(PTI, &[("resolution", resolution)]).unwrap();
        assert_eq!(by_level.report.resolution.to_string(), resolution);
        assert!(by_level.mesh.positions[..] == given.mesh.positions[..], "{level}");
        let case = (by_level.report.resolution_from, by_level.report.detail.map(usize::from));
        assert_eq!(case, ("detail", Some(level)));
        assert!(by_level.report.triangles > last + last / 2, "{level} is not finer than the level before");
        last = by_level.report.triangles;
    }
    // 27,000 atoms: three times as long as 1,000, and 1.39 times as long as 10,000.
    let large = cube(30, 2.0);
    assert_eq!(report(&large, &[("detail", "1")]).resolution.to_string(), "1.95");
    // Counts selected atoms, not those in the file.
    let small = String::from_utf8(cube(8, 2.0)).unwrap().replace("ALA A", "ALA B");
    let both = [&large[..], small.as_bytes()].concat();
    assert_eq!(report(&both, &[("detail", "1"), ("chains", "B")]).resolution.to_string(), "1.4");
}

#[test]
fn estimates_use_the_chosen_spacing() {
    for limit in ["3000", "30000"] {
        let (guess, made) = (expected(PTI, &[("max_triangles", limit)]), report(PTI, &[("max_triangles", limit)]));
        assert!((guess.resolution / made.resolution - 1.0).abs() < 0.1, "{} {}", guess.resolution, made.resolution);
        let mesh = guess.mesh.unwrap();
        let ratio = mesh.triangles as f64 / made.triangles as f64;
        assert!((0.8..1.25).contains(&ratio), "{ratio}");
        assert!(mesh.triangles <= limit.parse().unwrap());
    }
    let refused = expected(PTI, &[("max_triangles", "20")]);
    let made = product(PTI, &[("max_triangles", "20")]).unwrap_err();
    assert_eq!(JobError::Surface(refused.mesh.unwrap_err()), made);
    let (guess, made) = (expected(PTI, &[("detail", "2")]), report(PTI, &[("detail", "2")]));
    assert_eq!(
        (guess.resolution.to_bits(), guess.mesh.unwrap().grid_points),
        (made.resolution.to_bits(), made.grid_points)
    );
}
