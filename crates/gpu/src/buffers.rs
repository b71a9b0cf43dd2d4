//! Buffers that the stages bind.

use wgpu::{Buffer, BufferUsages, Device};

macro_rules! buffers {
    ($($(#[$doc:meta])+ $id:ident,)+) => {
        /// Buffer of a job. The build derives the variant from the name of the shader variable: `first_atoms` binds
        /// [`BufferId::FirstAtoms`].
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum BufferId {
            $($(#[$doc])+ $id,)+
            /// Case table, shared by all jobs.
            Cases,
        }

        impl BufferId {
            /// Buffers of which each job has its own: all except [`Self::Cases`], in the order of the variants.
            pub(super) const OF_JOB: [Self; Self::Cases.index()] = [$(Self::$id),+];
        }
    };
}

buffers! {
    /// Rows of parameters, one per dispatch.
    Params,
    /// Atoms on the lattice, and bounding spheres of arcs behind them.
    Atoms,
    /// Reach of each atom and arc, in spacings.
    Reaches,
    /// Boundary of a union of spheres: rows of caps and arcs.
    Boundary,
    /// Tile table.
    Tiles,
    /// Bricks by tile and index.
    Bricks,
    /// First atom of each brick, then first arc of each brick.
    FirstAtoms,
    /// Halo bricks of the chunk and the table of their slots.
    Halo,
    /// Candidate lists.
    Lists,
    /// Header of each candidate list: start, number of atoms that reach a grid point, number of all candidates, brick.
    /// Lists of atoms come first, then those of arcs.
    Heads,
    /// Densities, or distances to the surface.
    Field,
    /// Parameter of the vertex on each edge: three per grid point.
    Crossings,
    /// Bits of the grid points inside the surface.
    Inside,
    /// Result of `classify` for each brick: crossing edges, vertices per layer, neighbours.
    Records,
    /// Vertex and triangle counts of bricks.
    Counts,
    /// First vertex and first triangle of bricks.
    Offsets,
    /// Sums of the counts over groups of 1024 bricks.
    Groups,
    /// Counters that the host reads back.
    Counters,
    /// Vertex positions.
    Positions,
    /// Vertex normals.
    Normals,
    /// Nearest atom of each vertex, as index into the caller's input.
    Sources,
    /// Triangle indices.
    Triangles,
    /// Table of the offsets of the blocks of `measure`, and the blocks: one per brick that the surface intersects.
    Sheets,
}

impl BufferId {
    /// Returns the index of the buffer in [`Self::OF_JOB`], or the length of that array for [`Self::Cases`].
    pub(super) const fn index(self) -> usize {
        self as usize
    }
}

/// Creates a buffer.
pub(super) fn buffer(device: &Device, label: &str, size: u64, usage: BufferUsages) -> Buffer {
    device.create_buffer(&wgpu::BufferDescriptor { label: Some(label), size, usage, mapped_at_creation: false })
}
