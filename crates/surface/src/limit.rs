//! Limits: the table of their configuration keys, flags and problems, and the error of exceeding one.
//!
//! A row knows the names that other crates give a limit, not its value. Lengths are Å.

use std::borrow::Cow;
use std::error::Error;
use std::fmt;

/// Coarsest grid spacing that is accepted, Å.
pub const MAX_RESOLUTION: f64 = 20.0;

/// Limit. [`LIMITS`] describes it.
#[expect(missing_docs, reason = "the rows of the table describe the limits")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Limit {
    BodyBytes,
    PartHeadBytes,
    FormParts,
    InflatedBytes,
    MapBytes,
    MapPoints,
    Atoms,
    Duplicates,
    Copies,
    Parts,
    ModelParts,
    Distances,
    GridPoints,
    PocketPoints,
    PocketRows,
    Candidates,
    Overlaps,
    MeshBytes,
    Triangles,
    Tiles,
    TilesetBytes,
    PictureWidth,
    PictureHeight,
    DeviceBytes,
    FileBytes,
    FileVertices,
    FileTriangles,
    AtomIndex,
    EntryBytes,
    StoreBytes,
    ResultBytes,
    JobRecords,
    MemoryBytes,
    ScratchBytes,
}

/// Row of the table of limits.
#[derive(Debug)]
pub struct LimitRow {
    /// The limit.
    pub limit: Limit,
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
const NONE: LimitRow = LimitRow {
    limit: Limit::BodyBytes,
    subject: "",
    predicate: "",
    key: None,
    flag: None,
    parameter: None,
    hint: None,
    problem: "",
};

const PAIRS_KEY: Option<&str> = Some("limits.candidate_pairs");
const PAIRS_FLAG: Option<&str> = Some("--max-candidates");
const STORE_KEY: Option<&str> = Some("store.max_bytes");

/// All limits, in the order of [`Limit`].
#[rustfmt::skip]
pub const LIMITS: &[LimitRow] = &[
    LimitRow { limit: Limit::BodyBytes, subject: "the body", predicate: "has {} bytes", key: Some("limits.body_bytes"),
        problem: "body-too-large", ..NONE },
    LimitRow { limit: Limit::PartHeadBytes, subject: "the preamble or the headers of a part",
        predicate: "have {} bytes", problem: "body-too-large", ..NONE },
    LimitRow { limit: Limit::FormParts, subject: "the form", predicate: "has {} parts",
        problem: "body-too-large", ..NONE },
    LimitRow { limit: Limit::InflatedBytes, subject: "the structure", predicate: "has {} bytes",
        key: Some("limits.inflated_bytes"), flag: Some("--max-input-bytes"), problem: "inflated-too-large", ..NONE },
    LimitRow { limit: Limit::MapBytes, subject: "the map", predicate: "has {} bytes",
        key: Some("limits.inflated_bytes"), flag: Some("--max-input-bytes"), parameter: Some("map"),
        problem: "inflated-too-large", ..NONE },
    LimitRow { limit: Limit::MapPoints, subject: "the map", predicate: "has {} points", flag: Some("--max-map-points"),
        parameter: Some("map"), problem: "map-too-large", ..NONE },
    LimitRow { limit: Limit::Atoms, subject: "the structure", predicate: "has {} atoms", key: Some("limits.atoms"),
        flag: Some("--max-atoms"), problem: "too-many-atoms", ..NONE },
    LimitRow { limit: Limit::Duplicates, subject: "a position", predicate: "has {} atoms",
        flag: Some("--max-duplicates"), problem: "too-many-duplicates", ..NONE },
    LimitRow { limit: Limit::Copies, subject: "the assembly", predicate: "has {} copies of chains",
        flag: Some("--max-copies"), problem: "too-many-copies", ..NONE },
    LimitRow { limit: Limit::Parts, subject: "split", predicate: "divides the selected atoms into {} parts",
        flag: Some("--max-parts"), parameter: Some("split"), problem: "too-many-parts", ..NONE },
    LimitRow { limit: Limit::ModelParts, subject: "model=all", predicate: "divides the selected atoms into {} parts",
        flag: Some("--max-parts"), parameter: Some("model"), problem: "too-many-parts", ..NONE },
    LimitRow { limit: Limit::Distances, subject: "`within`",
        predicate: "tests {} distances between atoms (64 count as a pair)",
        key: PAIRS_KEY, flag: PAIRS_FLAG, parameter: Some("select"),
        hint: Some("fewer atoms after `of` or a smaller distance"), problem: "too-many-candidates" },
    LimitRow { limit: Limit::GridPoints, subject: "the grid", predicate: "would need about {} grid points",
        key: Some("limits.grid_points"), flag: Some("--max-grid-points"), problem: "grid-too-large", ..NONE },
    LimitRow { limit: Limit::PocketPoints, subject: "the search for pockets", predicate: "would need {} grid points",
        key: Some("limits.grid_points"), flag: Some("--max-grid-points"), parameter: Some("pockets"),
        hint: Some("a smaller selection or a smaller pocket_probe"), problem: "grid-too-large" },
    LimitRow { limit: Limit::PocketRows, subject: "the search for pockets",
        predicate: "would pass over {} rows of grid points in reach of the probes (5 count as a pair)",
        key: PAIRS_KEY, flag: PAIRS_FLAG,
        parameter: Some("pockets"), hint: Some("fewer atoms, smaller radii or a smaller pocket_probe"),
        problem: "too-many-candidates" },
    LimitRow { limit: Limit::Candidates, subject: "the spheres",
        predicate: "would reach at least {} grid bricks in total", key: PAIRS_KEY, flag: PAIRS_FLAG,
        hint: Some("smaller radii or a coarser resolution"), problem: "too-many-candidates", ..NONE },
    LimitRow { limit: Limit::Overlaps, subject: "enlarged by the probe, the spheres",
        predicate: "have at least {} overlapping pairs (64 comparisons of overlaps count as a pair)",
        key: PAIRS_KEY, flag: PAIRS_FLAG, hint: Some("a smaller probe or smaller radii"),
        problem: "too-many-candidates", ..NONE },
    LimitRow { limit: Limit::MeshBytes, subject: "the mesh", predicate: "would take about {} bytes",
        key: Some("limits.mesh_bytes"), flag: Some("--max-mesh-bytes"), problem: "mesh-too-large", ..NONE },
    LimitRow { limit: Limit::Triangles, subject: "the mesh", predicate: "has {} triangles",
        flag: Some("--max-triangles"), parameter: Some("max_triangles"), problem: "mesh-too-large", ..NONE },
    LimitRow { limit: Limit::Tiles, subject: "the tileset", predicate: "would have {} tiles",
        hint: Some("a coarser resolution"), problem: "grid-too-large", ..NONE },
    LimitRow { limit: Limit::TilesetBytes, subject: "the index of the tileset", predicate: "has {} bytes",
        key: Some("limits.structure_cache_bytes"), problem: "too-much-memory", ..NONE },
    LimitRow { limit: Limit::PictureWidth, subject: "the width of the picture", predicate: "is {} pixels",
        parameter: Some("width"), problem: "picture-too-large", ..NONE },
    LimitRow { limit: Limit::PictureHeight, subject: "the height of the picture", predicate: "is {} pixels",
        parameter: Some("height"), problem: "picture-too-large", ..NONE },
    LimitRow { limit: Limit::DeviceBytes, subject: "the job", predicate: "would need {} bytes of memory of the device",
        hint: Some("the backend cpu"), problem: "device-memory", ..NONE },
    LimitRow { limit: Limit::FileBytes, subject: "the file", predicate: "would have {} bytes",
        problem: "mesh-too-large", ..NONE },
    LimitRow { limit: Limit::FileVertices, subject: "the file", predicate: "would have {} vertices",
        problem: "mesh-too-large", ..NONE },
    LimitRow { limit: Limit::FileTriangles, subject: "the file", predicate: "would have {} triangles",
        problem: "mesh-too-large", ..NONE },
    LimitRow { limit: Limit::AtomIndex, subject: "an atom index in the file", predicate: "is {}",
        parameter: Some("atom_ids"), hint: Some("the format ply"), problem: "mesh-too-large", ..NONE },
    LimitRow { limit: Limit::EntryBytes, subject: "the file of the archive", predicate: "has {} bytes",
        problem: "entry-too-large", ..NONE },
    LimitRow { limit: Limit::StoreBytes, subject: "the file", predicate: "needs {} bytes in the store",
        key: STORE_KEY, problem: "body-too-large", ..NONE },
    LimitRow { limit: Limit::ResultBytes, subject: "the file", predicate: "would need {} bytes in the store",
        key: STORE_KEY, problem: "mesh-too-large", ..NONE },
    LimitRow { limit: Limit::JobRecords, subject: "the client", predicate: "would have {} open jobs on record",
        key: Some("jobs.records_per_client"), problem: "too-many-jobs", ..NONE },
    LimitRow { limit: Limit::MemoryBytes, subject: "the request", predicate: "needs at least {} bytes of memory at once",
        key: Some("limits.memory_bytes"), problem: "too-much-memory", ..NONE },
    LimitRow { limit: Limit::ScratchBytes, subject: "the index of the atoms",
        predicate: "needs at least {} bytes of disk space", key: Some("limits.scratch_bytes"),
        problem: "too-much-memory", ..NONE },
];

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
    fn rows_are_in_the_order_of_the_limits() {
        for (i, row) in LIMITS.iter().enumerate() {
            assert_eq!(row.limit as usize, i, "{row:?}");
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
