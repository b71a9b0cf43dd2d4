//! Buffers that the stages bind.

/// Buffer of a job. The build derives the variant from the name of the shader variable: `first_atoms` binds
/// [`BufferId::FirstAtoms`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BufferId {
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
    /// Case table, shared by all jobs.
    Cases,
}

impl BufferId {
    /// Buffers of which each job has its own: all except [`Self::Cases`], in the order of the variants.
    pub(super) const OF_JOB: [Self; 23] = [
        Self::Params,
        Self::Atoms,
        Self::Reaches,
        Self::Boundary,
        Self::Tiles,
        Self::Bricks,
        Self::FirstAtoms,
        Self::Halo,
        Self::Lists,
        Self::Heads,
        Self::Field,
        Self::Crossings,
        Self::Inside,
        Self::Records,
        Self::Counts,
        Self::Offsets,
        Self::Groups,
        Self::Counters,
        Self::Positions,
        Self::Normals,
        Self::Sources,
        Self::Triangles,
        Self::Sheets,
    ];

    /// Returns the index of the buffer in [`Self::OF_JOB`], or the length of that array for [`Self::Cases`].
    pub(super) const fn index(self) -> usize {
        self as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_of_a_job_are_listed_by_index() {
        assert!(BufferId::OF_JOB.iter().enumerate().all(|(i, id)| id.index() == i));
        assert_eq!(BufferId::Cases.index(), BufferId::OF_JOB.len());
    }
}
