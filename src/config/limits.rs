//! What one request may cost, checked before anything is allocated for it.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::picture::PictureLimits;
use crate::pipeline::JobLimits;
use crate::structure::ReadLimits;
use crate::surface::SurfaceLimits;

/// Limits of a request, and of all of them together.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LimitsConfig {
    /// Bytes of a request body as sent. Default 256 MiB: the largest entries of the archive are about 100 MB
    /// compressed.
    pub body_bytes: u64,
    /// Bytes of a JSON request body. Default 64 KiB: a document names a structure and has about thirty parameters.
    pub json_bytes: u64,
    /// Bytes ahead of the content of a form's part: its headers, and the preamble in front of the first one. Default
    /// 16 KiB: browsers send a few hundred.
    pub part_head_bytes: u64,
    /// Parts of a form. Default 128: one file and every parameter once are fewer than half.
    pub parts: usize,
    /// Bytes of a structure after decompression. Default 2 GiB: the largest entries inflate to about 1 GB; a
    /// compression bomb stops here.
    pub inflated_bytes: u64,
    /// Atoms in all models of a structure. Default 10,000,000: four times the largest entry of the archive; at
    /// 80 bytes each they take 800 MB.
    pub atoms: u64,
    /// Atoms of a structure whose names are listed, for front ends that show them. Default 1,000,000: some 10 MB of
    /// JSON; beyond that a browser is better served without.
    pub labels: u64,
    /// Grid samples in occupied bricks. Default 1,073,741,824: two million atoms at 0.5 Å; as 32-bit numbers
    /// they take 4 GiB.
    pub grid_samples: u64,
    /// Pairs of an atom and a grid brick (8³ samples) within its reach. Default 268,435,456: 128 atoms for each brick
    /// of `grid_samples`, several times as many as ordinary structures have. Bounds time, some 16 s of one core, and
    /// the memory of candidate lists, 4 to 12 bytes a pair. At most 2,147,483,648.
    pub candidate_pairs: u64,
    /// Bytes of a mesh in memory (24 a vertex, 12 a triangle). Default 2 GiB: 85 million triangles.
    pub mesh_bytes: u64,
    /// Bytes of a mesh file. Default 3 GiB: below the 4 GiB that a GLB can say, and text formats take more than
    /// the mesh in memory.
    pub output_bytes: u64,
    /// Bytes of uploads, finished meshes and responses being sent that all requests together hold in memory. Default
    /// 8 GiB. A new upload, job or stored result is refused while it is used up; running jobs may overshoot it by
    /// `mesh_bytes` and the candidate lists of `candidate_pairs` each, responses by their next piece.
    pub memory_bytes: u64,
    /// Pixels of a picture's width and of its height. Default 4,096: at 40 bytes a pixel the working memory of the largest is
    /// 640 MiB, and drawing it takes seconds.
    pub picture_side: u32,
}

impl Default for LimitsConfig {
    fn default() -> Self {
        Self {
            body_bytes: 256 << 20,
            json_bytes: 64 << 10,
            part_head_bytes: 16 << 10,
            parts: 128,
            inflated_bytes: 2 << 30,
            atoms: 10_000_000,
            labels: 1_000_000,
            grid_samples: 1 << 30,
            candidate_pairs: 1 << 28,
            mesh_bytes: 2 << 30,
            output_bytes: 3 << 30,
            memory_bytes: 8 << 30,
            picture_side: 4096,
        }
    }
}

impl LimitsConfig {
    /// The limits of reading, meshing and drawing.
    #[must_use]
    pub fn job(&self) -> JobLimits {
        JobLimits {
            read: ReadLimits { max_inflated_bytes: self.inflated_bytes, max_atoms: self.atoms },
            surface: SurfaceLimits {
                max_samples: self.grid_samples,
                max_mesh_bytes: self.mesh_bytes,
                max_candidates: self.candidate_pairs,
            },
            picture: PictureLimits { max_side: self.picture_side },
            deadline: None,
        }
    }
}
