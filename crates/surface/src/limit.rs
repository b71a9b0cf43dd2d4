//! Limits: the table of their configuration keys, flags and problems, and the error of exceeding one.
//!
//! A row knows the names that other crates give a limit, not its value. Lengths are Å.

use std::borrow::Cow;
use std::error::Error;
use std::fmt;

/// Coarsest grid spacing that is accepted, Å.
pub const MAX_RESOLUTION: f64 = 20.0;

/// Row of the table of limits.
#[derive(Debug)]
pub struct LimitRow {
    /// Subject of the error message, unless the error has another one.
    subject: &'static str,
    /// Rest of the sentence, with `{}` for the number.
    predicate: &'static str,
    /// Configuration key of the service.
    pub key: Option<&'static str>,
    /// Flag of the command line.
    pub flag: Option<&'static str>,
    /// Parameter of a request because of which the limit applies.
    pub parameter: Option<&'static str>,
    /// Request that may fit, such as `a smaller probe`.
    hint: Option<&'static str>,
    /// Name of the problem type in answers of the service.
    pub problem: &'static str,
}

/// Row without names, the base of the others.
const NONE: LimitRow =
    LimitRow { subject: "", predicate: "", key: None, flag: None, parameter: None, hint: None, problem: "" };

const PAIRS_KEY: &str = "limits.candidate_pairs";
const PAIRS_FLAG: &str = "--max-candidates";
const STORE_KEY: &str = "store.max_bytes";

/// Defines all limits: name, subject, predicate, problem, and other fields of the row.
macro_rules! limits {
    ($($limit:ident: $subject:literal, $predicate:literal, $problem:literal $(, $field:ident: $value:expr)*;)+) => {
        /// Limit. [`LIMITS`] describes it.
        #[expect(missing_docs, reason = "the rows of the table describe the limits")]
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum Limit { $($limit),+ }

        /// All limits, in the order of [`Limit`].
        #[expect(clippy::needless_update, reason = "some rows have all fields")]
        pub const LIMITS: &[LimitRow] = &[$(LimitRow {
            subject: $subject, predicate: $predicate, problem: $problem, $($field: Some($value),)* ..NONE
        }),+];
    };
}

limits! {
    BodyBytes: "the body", "has {} bytes", "body-too-large", key: "limits.body_bytes";
    PartHeadBytes: "the preamble or the headers of a part", "have {} bytes", "body-too-large";
    FormParts: "the form", "has {} parts", "body-too-large";
    InflatedBytes: "the structure", "has {} bytes", "inflated-too-large", key: "limits.inflated_bytes",
        flag: "--max-input-bytes";
    MapBytes: "the map", "has {} bytes", "inflated-too-large", key: "limits.inflated_bytes", flag: "--max-input-bytes",
        parameter: "map";
    MapPoints: "the map", "has {} points", "map-too-large", flag: "--max-map-points", parameter: "map";
    Atoms: "the structure", "has {} atoms", "too-many-atoms", key: "limits.atoms", flag: "--max-atoms";
    Duplicates: "a position", "has {} atoms", "too-many-duplicates", flag: "--max-duplicates";
    Copies: "the assembly", "has {} copies of chains", "too-many-copies", flag: "--max-copies";
    Parts: "split", "divides the selected atoms into {} parts", "too-many-parts", flag: "--max-parts",
        parameter: "split";
    ModelParts: "model=all", "divides the selected atoms into {} parts", "too-many-parts", flag: "--max-parts",
        parameter: "model";
    Distances: "`within`", "tests {} distances between atoms (64 count as a pair)", "too-many-candidates",
        key: PAIRS_KEY, flag: PAIRS_FLAG, parameter: "select", hint: "fewer atoms after `of` or a smaller distance";
    GridPoints: "the grid", "would need about {} grid points", "grid-too-large", key: "limits.grid_points",
        flag: "--max-grid-points";
    PocketPoints: "the search for pockets", "would need {} grid points", "grid-too-large", key: "limits.grid_points",
        flag: "--max-grid-points", parameter: "pockets", hint: "a smaller selection or a smaller pocket_probe";
    PocketRows: "the search for pockets",
        "would pass over {} rows of grid points in reach of the probes (5 count as a pair)", "too-many-candidates",
        key: PAIRS_KEY, flag: PAIRS_FLAG, parameter: "pockets",
        hint: "fewer atoms, smaller radii or a smaller pocket_probe";
    Candidates: "the spheres", "would reach at least {} grid bricks in total", "too-many-candidates", key: PAIRS_KEY,
        flag: PAIRS_FLAG, hint: "smaller radii or a coarser resolution";
    Overlaps: "enlarged by the probe, the spheres",
        "have at least {} overlapping pairs (64 comparisons of overlaps count as a pair)", "too-many-candidates",
        key: PAIRS_KEY, flag: PAIRS_FLAG, hint: "a smaller probe or smaller radii";
    MeshBytes: "the mesh", "would take about {} bytes", "mesh-too-large", key: "limits.mesh_bytes",
        flag: "--max-mesh-bytes";
    Triangles: "the mesh", "has {} triangles", "mesh-too-large", flag: "--max-triangles", parameter: "max_triangles";
    Tiles: "the tileset", "would have {} tiles", "grid-too-large", hint: "a coarser resolution";
    TilesetBytes: "the index of the tileset", "has {} bytes", "too-much-memory", key: "limits.structure_cache_bytes";
    PictureWidth: "the width of the picture", "is {} pixels", "picture-too-large", parameter: "width";
    PictureHeight: "the height of the picture", "is {} pixels", "picture-too-large", parameter: "height";
    DeviceBytes: "the job", "would need {} bytes of memory of the device", "device-memory", hint: "the backend cpu";
    FileBytes: "the file", "would have {} bytes", "mesh-too-large";
    FileVertices: "the file", "would have {} vertices", "mesh-too-large";
    FileTriangles: "the file", "would have {} triangles", "mesh-too-large";
    AtomIndex: "an atom index in the file", "is {}", "mesh-too-large", parameter: "atom_ids", hint: "the format ply";
    EntryBytes: "the file of the archive", "has {} bytes", "entry-too-large";
    StoreBytes: "the file", "needs {} bytes in the store", "body-too-large", key: STORE_KEY;
    ResultBytes: "the file", "would need {} bytes in the store", "mesh-too-large", key: STORE_KEY;
    JobRecords: "the client", "would have {} open jobs on record", "too-many-jobs", key: "jobs.records_per_client";
    MemoryBytes: "the request", "needs at least {} bytes of memory at once", "too-much-memory",
        key: "limits.memory_bytes";
    ScratchBytes: "the index of the atoms", "needs at least {} bytes of disk space", "too-much-memory",
        key: "limits.scratch_bytes";
}

impl Limit {
    /// Returns the row of the limit.
    #[must_use]
    pub const fn row(self) -> &'static LimitRow {
        &LIMITS[self as usize]
    }
}

/// Error of an exceeded limit.
#[derive(Debug, Clone, PartialEq)]
pub struct Exceeded {
    /// The limit.
    pub limit: Limit,
    /// Largest number allowed.
    pub max: u64,
    /// Number needed, if it is known: exact, an estimate or a lower bound.
    pub actual: Option<u64>,
    /// True if neither key nor flag changes the limit, such as that of 32-bit indices.
    pub is_fixed: bool,
    /// Subject of the message: thing that exceeds the limit.
    pub subject: Cow<'static, str>,
    /// Request that may fit.
    pub hint: Option<Cow<'static, str>>,
    /// Grid spacing at which the limit is exceeded, Å.
    pub resolution: Option<f64>,
    /// Grid spacing at which the work probably fits, Å, if there is one. It is an estimate that errs on the coarse
    /// side. The work may still exceed another limit there.
    pub suggested_resolution: Option<f64>,
    /// Position of the atoms that exceed the limit, Å.
    pub position: Option<[f64; 3]>,
}

impl Exceeded {
    /// Returns the error for more than `max`.
    #[must_use]
    pub fn new(limit: Limit, max: u64) -> Self {
        let LimitRow { subject, hint, .. } = *limit.row();
        Self {
            limit,
            max,
            actual: None,
            is_fixed: false,
            subject: subject.into(),
            hint: hint.map(Cow::from),
            resolution: None,
            suggested_resolution: None,
            position: None,
        }
    }

    /// Returns the error for more than `configured` or the fixed `cap`, whichever is lower.
    #[must_use]
    pub fn capped(limit: Limit, configured: u64, cap: u64) -> Self {
        Self { is_fixed: cap < configured, ..Self::new(limit, configured.min(cap)) }
    }

    /// Suggests a grid spacing, Å, unless it is too coarse.
    #[must_use]
    pub fn suggest(self, spacing: f64) -> Self {
        Self { suggested_resolution: Some(spacing).filter(|spacing| *spacing <= MAX_RESOLUTION), ..self }
    }

    /// Suggests a grid spacing for an actual number that grows with the inverse square of the present `spacing`, Å, as
    /// those of a mesh do: its area stays the same.
    #[must_use]
    pub fn suggest_for_area(self, spacing: f64) -> Self {
        let excess = self.actual.unwrap_or(self.max) as f64 / self.max.max(1) as f64;
        self.suggest(slightly_coarser(spacing * excess.max(1.0).sqrt()))
    }

    /// Converts the error to that of a crate.
    #[must_use]
    pub fn error<E: From<Box<Self>>>(self) -> E {
        Box::new(self).into()
    }

    /// Returns the message, with the `name` under which its reader knows the limit.
    #[must_use]
    pub fn message(&self, name: Option<&str>) -> String {
        let number = self.actual.map_or_else(|| format!("more than {}", self.max), |actual| actual.to_string());
        let mut text = format!("{} {}", self.subject, self.limit.row().predicate.replace("{}", &number));
        let parts = [
            self.resolution.map(|resolution| format!(" at {resolution} Å")),
            self.actual.map(|_| format!(", the limit is {}", self.max)),
            name.map(|name| format!(" ({name})")),
            self.suggested_resolution.map(|spacing| format!("; a resolution of {spacing} Å should fit")),
            self.hint.as_ref().map(|hint| format!("; try {hint}")),
        ];
        text.extend(parts.into_iter().flatten());
        text
    }

    /// Returns the configuration key that changes the limit.
    #[must_use]
    pub fn key(&self) -> Option<&'static str> {
        self.limit.row().key.filter(|_| !self.is_fixed)
    }

    /// Returns the flag of the command line that changes the limit.
    #[must_use]
    pub fn flag(&self) -> Option<&'static str> {
        self.limit.row().flag.filter(|_| !self.is_fixed)
    }
}

impl fmt::Display for Exceeded {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message(None))
    }
}

impl Error for Exceeded {}

/// Returns a spacing about 5 % above an estimate, rounded up to hundredths of an Å, as a suggestion.
#[must_use]
pub fn slightly_coarser(spacing: f64) -> f64 {
    (spacing * 105.0).ceil() / 100.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_have_a_subject_a_predicate_and_a_problem() {
        for row in LIMITS {
            assert!(row.predicate.contains("{}") && !row.subject.is_empty() && !row.problem.is_empty(), "{row:?}");
        }
    }

    #[test]
    fn messages_name_number_limit_key_and_suggestion() {
        let grid = Exceeded { actual: Some(9), resolution: Some(0.1), ..Exceeded::new(Limit::GridPoints, 1) };
        let grid = grid.suggest(0.4);
        assert_eq!(
            grid.message(grid.key()),
            "the grid would need about 9 grid points at 0.1 Å, the limit is 1 (limits.grid_points); a resolution of \
             0.4 Å should fit"
        );
        assert_eq!(
            Exceeded::new(Limit::Tiles, 5).to_string(),
            "the tileset would have more than 5 tiles; try a coarser resolution"
        );
    }

    #[test]
    fn a_cap_below_the_configured_limit_names_no_key() {
        let error = |configured| Exceeded::capped(Limit::Atoms, configured, 10);
        assert_eq!((error(9).key(), error(9).flag()), (Some("limits.atoms"), Some("--max-atoms")));
        assert_eq!((error(10).key(), error(10).max), (Some("limits.atoms"), 10));
        assert_eq!((error(11).key(), error(11).flag()), (None, None));
        assert_eq!(error(11).to_string(), "the structure has more than 10 atoms");
    }

    #[test]
    fn spacings_are_suggested_up_to_the_coarsest_one() {
        let error = |actual| Exceeded { actual: Some(actual), ..Exceeded::new(Limit::FileBytes, 100) };
        let suggested = |actual| error(actual).suggest_for_area(0.5).suggested_resolution;
        assert_eq!((suggested(400), suggested(200_000)), (Some(1.05), None));
    }
}
