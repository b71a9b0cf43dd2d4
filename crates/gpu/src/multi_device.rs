//! Multi-device jobs: the number of partitions of a large job, and the mesh of its partitions.
//!
//! Each device computes one partition: it counts, publishes its counts and computes its vertices. Once all partitions
//! have published their counts, it computes its triangles with the final vertex numbers. The mesh has the same bytes as
//! that of one device.

use molmesh_surface::vector::joined_bounds;
use molmesh_surface::{GridStats, Mesh, MeshOutput, Stage};

use super::job::Finished;
use super::sheets::SheetBlocks;

/// Number of devices for a job of `n_bricks`, given `idle` devices and a minimum of bricks per partition. A job runs on
/// one device if the result is 1, which is always the case without a minimum.
pub(super) fn n_partitions(n_bricks: u64, idle: usize, min_bricks: Option<u64>) -> usize {
    let by_size = min_bricks.map_or(1, |min| n_bricks / min.max(1));
    idle.min(usize::try_from(by_size).unwrap_or(usize::MAX)).max(1)
}

/// Joins the meshes of partitions, given in order. A stage's time is the longest of all devices. With
/// `has_flat_vertices`, computes the normals of vertices without a gradient.
pub(super) fn join(partitions: Vec<Finished>, has_flat_vertices: bool) -> Finished {
    let stages = max_times(&partitions);
    let mut mesh = Mesh::default();
    let mut grid = GridStats::default();
    let mut sheets = SheetBlocks::default();
    let mut bounds = None;
    for Finished { meshed, sheets: next, .. } in partitions {
        bounds = bounds.into_iter().chain(meshed.bounds).reduce(joined_bounds);
        sheets.append(next);
        let surface_bricks = grid.surface_bricks + meshed.grid.surface_bricks;
        grid = GridStats { surface_bricks, ..meshed.grid };
        mesh.append(meshed.mesh);
    }
    if has_flat_vertices {
        mesh.fill_flat_normals();
    }
    Finished { meshed: MeshOutput { bounds, ..MeshOutput::new(mesh, grid) }, stages, sheets }
}

/// Maximum time per stage over all partitions, which run side by side.
fn max_times(partitions: &[Finished]) -> Vec<(Stage, u64)> {
    let mut stages: Vec<(Stage, u64)> = Vec::new();
    for &(stage, ns) in partitions.iter().flat_map(|partition| &partition.stages) {
        match stages.iter_mut().find(|(known, _)| *known == stage) {
            Some((_, max)) => *max = ns.max(*max),
            None => stages.push((stage, ns)),
        }
    }
    stages.sort_unstable();
    stages
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_partition_has_the_minimum_of_bricks() {
        let parts = |n_bricks, idle| n_partitions(n_bricks, idle, Some(100));
        assert_eq!([parts(0, 4), parts(199, 4), parts(200, 4), parts(350, 4), parts(9000, 4)], [1, 1, 2, 3, 4]);
        assert_eq!([parts(9000, 1), parts(9000, 0), n_partitions(1 << 40, 8, None)], [1, 1, 1]);
        assert_eq!(n_partitions(5, 3, Some(0)), 3);
    }

    #[test]
    fn the_maximum_time_of_a_stage_counts() {
        let finished = |stages: &[(Stage, u64)]| Finished {
            meshed: MeshOutput::new(Mesh::default(), GridStats::default()),
            stages: stages.to_vec(),
            sheets: SheetBlocks::default(),
        };
        let all = [
            finished(&[(Stage::Bin, 5), (Stage::Field, 9)]),
            finished(&[]),
            finished(&[(Stage::Bin, 7), (Stage::Emit, 1)]),
        ];
        assert_eq!(max_times(&all), [(Stage::Bin, 7), (Stage::Field, 9), (Stage::Emit, 1)]);
    }
}
