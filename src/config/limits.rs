//! Configuration of the limits of a request, which are checked before memory is allocated.

use crate::picture::PictureLimits;
use crate::pipeline::JobLimits;
use crate::structure::ReadLimits;
use crate::structure::map::MapLimits;
use crate::structure::read::DISTANCES_PER_PAIR;
use crate::surface::SurfaceLimits;

section! {
    /// Limits of a request and of all requests together.
    LimitsConfig;
    /// Size of a request body as sent, bytes. Default 256 MiB: the largest PDB entries have about 100 MB compressed.
    body_bytes: u64 = 256 << 20;
    /// Size of a structure or map file after decompression, bytes. Default 2 GiB: the largest entries inflate to about
    /// 1 GB. Stops compression bombs.
    inflated_bytes: u64 = 2 << 30;
    /// Number of atoms in all models of a structure, and of an assembly. Default 10,000,000: four times the largest PDB
    /// entry; at 80 bytes each 800 MB.
    atoms: u64 = 10_000_000;
    /// Number of copies of chains in an assembly, or of instances. Fixed: six times as many as in the largest virus of
    /// the PDB.
    #[serde(skip)]
    assembly_copies: u64 = 10_000;
    /// Number of grid points of a map for `color=map`. Fixed: 406 along each axis, 256 MiB in memory.
    #[serde(skip)]
    map_points: u64 = 64 << 20;
    /// Number of atoms whose names or colours are listed, for web pages that show them. Fixed: about 10 MB of JSON, the
    /// most that is useful in a browser.
    #[serde(skip)]
    labels: u64 = 1_000_000;
    /// Number of grid points in occupied bricks. Default 1,073,741,824: two million atoms at 0.5 Å; 4 GiB as 32-bit
    /// numbers.
    grid_points: u64 = 1 << 30;
    /// Number of pairs of an atom and a brick (8³ grid points) that its support reaches. Default 134,217,728: 64 atoms
    /// per brick of `grid_points`, several times the number in ordinary structures. Limits the computing time to about
    /// 25 s of one core, and the memory of candidate lists, 4 to 12 bytes a pair. At most 2,147,483,648. Also limits
    /// the search for overlapping spheres and, for each pair, `within` to 64 tested distances and the search for
    /// pockets to 5 rows of grid points.
    candidate_pairs: u64 = 1 << 27;
    /// Size of a mesh in memory (24 bytes a vertex, 12 a triangle), bytes. Default 2 GiB: 85 million triangles.
    mesh_bytes: u64 = 2 << 30;
    /// Size of a mesh file, bytes. Fixed: below the 4 GiB limit of GLB, and above the default of `mesh_bytes` because
    /// text formats are larger.
    #[serde(skip)]
    output_bytes: u64 = 3 << 30;
    /// Memory of all requests together, bytes: uploads, jobs from decompression to the finished mesh, responses, and
    /// buffers of connections. Default 8 GiB, or half of the memory of the machine or control group if that is less.
    /// Memory is counted before it is allocated. A request or job that would exceed the limit is rejected and may be
    /// repeated later. Responses may exceed it by their next chunk.
    memory_bytes: u64 = 8 << 30;
    /// Part of `memory_bytes` for structures that are kept after they were read, bytes. Default 512 MiB: 8 million
    /// atoms. Further requests for the same file do not read it again. The least recently used structures are evicted,
    /// also before a request is rejected for lack of memory. 0 keeps none.
    structure_cache_bytes: u64 = 512 << 20;
    /// Maximum size of temporary files in `server.data_dir`, bytes. They hold the indexes of tilesets that are larger
    /// than `structure_cache_bytes`, and archives of batches until their jobs are accepted. Default 4 GiB: about 80
    /// million atoms at 48 bytes, with their groups. At the limit, the least recently used index that is not in use is
    /// removed. 0 rejects such tilesets and archives.
    scratch_bytes: u64 = 4 << 30;
    /// Width and height of a picture, pixels. Fixed: at 40 bytes a pixel the largest picture needs 640 MiB, and
    /// rendering takes seconds.
    #[serde(skip)]
    picture_side: u32 = 4096;
}

impl LimitsConfig {
    /// Returns the limits of reading, meshing and rendering.
    #[must_use]
    pub fn job(&self) -> JobLimits {
        JobLimits {
            read: ReadLimits {
                max_inflated_bytes: self.inflated_bytes,
                max_atoms: self.atoms,
                max_copies: self.assembly_copies,
                max_distances: self.candidate_pairs.saturating_mul(DISTANCES_PER_PAIR),
                ..ReadLimits::default()
            },
            surface: SurfaceLimits {
                max_grid_points: self.grid_points,
                max_mesh_bytes: self.mesh_bytes,
                max_candidates: self.candidate_pairs,
            },
            picture: PictureLimits { max_side: self.picture_side },
            map: MapLimits { max_points: self.map_points, max_inflated_bytes: self.inflated_bytes },
        }
    }
}
