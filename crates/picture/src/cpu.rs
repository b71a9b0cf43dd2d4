//! CPU renderer, parallel over tiles.

use std::sync::Arc;

use molmesh_surface::{Control, Mesh};
use rayon::prelude::*;

use super::bins::{Bins, TILE_HEIGHT, Tiles};
use super::camera::Camera;
use super::finish::{Finish, finish};
use super::layers::Layers;
use super::raster::{Band, Samples, fill};
use super::{MeshColumns, PictureError, PictureParams, Rendered, Renderer};

/// Memory of the bins, bytes per triangle.
const BIN_BYTES: u64 = 16;

/// Renderer on the threads of the current pool.
#[derive(Debug, Clone, Copy)]
pub struct CpuRenderer;

impl Renderer for CpuRenderer {
    fn name(&self) -> &'static str {
        "cpu"
    }

    fn describe(&self) -> String {
        let threads = rayon::current_num_threads();
        format!("CPU rasterizer, {threads} thread{}", if threads == 1 { "" } else { "s" })
    }

    fn render(
        &self,
        mesh: &Arc<Mesh>,
        params: &PictureParams,
        control: &Control<'_>,
    ) -> Result<Rendered, PictureError> {
        let columns = MeshColumns::of(mesh)?;
        let camera = Camera::new(columns.positions, columns.triangles, params);
        control.check()?;
        let (width, height) = (params.width as usize, params.height as usize);
        let tiles = Tiles::of(width, height);
        // A pair of tile and triangle, before and after sorting; few triangles lie in several tiles.
        let memory = control.reserve(BIN_BYTES * columns.triangles.len() as u64)?;
        let bins = Bins::new(columns.positions, columns.triangles, &camera, tiles, control)?;
        let mut layers = Layers::empty(width, height, columns.colors.is_some());
        let rows = TILE_HEIGHT * width;
        let bands = layers.depth.par_chunks_mut(rows).zip(layers.light.par_chunks_mut(rows));
        let bands = bands.zip(layers.facing.par_chunks_mut(rows)).zip(layers.color.par_chunks_mut(rows)).enumerate();
        bands.try_for_each_init(Samples::default, |samples, (n, (((depth, light), facing), color))| {
            let mut band = Band { top: n * TILE_HEIGHT, width, depth, light, facing, color };
            fill(columns, &camera, &bins, tiles, &mut band, samples, control)
        })?;
        drop((bins, memory));
        let image = finish(&layers, &Finish::new(params, &camera), params, control)?;
        Ok(Rendered { image, pixel: camera.pixel(), made_by: None })
    }
}
