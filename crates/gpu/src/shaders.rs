//! Shaders with their reflection. The build assembles, validates and reflects them.

use wgpu::{BufferBindingType, ShaderStages};

use super::buffers::BufferId;
use super::plan::layout::Params;

/// Access of a shader to a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    Uniform,
    Read,
    Write,
}

/// Buffer binding of a shader. `B` identifies the buffer: [`BufferId`] in the meshing stages, else the variable's name.
#[derive(Debug)]
pub(super) struct Binding<B: 'static> {
    pub(super) buffer: B,
    pub(super) number: u32,
    pub(super) access: Access,
}

/// Shader with its reflection.
#[derive(Debug)]
pub(super) struct Shader<B: 'static = &'static str> {
    /// Name of the stage.
    pub(super) stage: &'static str,
    /// Source with all fragments included.
    pub(super) source: &'static str,
    pub(super) bindings: &'static [Binding<B>],
}

/// Struct in a buffer as a shader declares it.
#[cfg(test)]
#[derive(Debug)]
pub(super) struct StructLayout {
    name: &'static str,
    size: usize,
    /// Name, offset and size of each field.
    fields: &'static [(&'static str, usize, usize)],
}

include!(concat!(env!("OUT_DIR"), "/shaders.rs"));

/// Returns the complete WGSL source of every meshing stage, by stage name and in execution order.
pub fn stage_shaders() -> impl Iterator<Item = (&'static str, &'static str)> {
    SHADERS.iter().map(|shader| (shader.stage, shader.source))
}

impl Binding<BufferId> {
    /// Layout entry of the binding. Parameters have a dynamic offset, which selects a row of their buffer.
    pub(super) fn layout(&self) -> wgpu::BindGroupLayoutEntry {
        let (ty, is_params) = match self.access {
            Access::Uniform => (BufferBindingType::Uniform, true),
            Access::Read => (BufferBindingType::Storage { read_only: true }, false),
            Access::Write => (BufferBindingType::Storage { read_only: false }, false),
        };
        wgpu::BindGroupLayoutEntry {
            binding: self.number,
            visibility: ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty,
                has_dynamic_offset: is_params,
                min_binding_size: is_params.then(|| wgpu::BufferSize::new(size_of::<Params>() as u64)).flatten(),
            },
            count: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use molmesh_surface::Stage;
    use molmesh_surface::lattice::LatticeAtom;

    use super::*;
    use crate::plan::layout::{BrickRecord, Counters, Tile};

    /// Name, size and (field, offset) of a struct on the host.
    type Host = (&'static str, usize, Vec<(&'static str, usize)>);

    macro_rules! host {
        ($name:literal, $type:ty, $($field:ident),+) => {
            ($name, size_of::<$type>(), vec![$((stringify!($field), offset_of!($type, $field))),+])
        };
    }

    fn host() -> Vec<Host> {
        vec![
            host!("Atom", LatticeAtom, cell, inv_length2, frac, source),
            host!(
                "Params",
                Params,
                centre,
                spacing,
                isovalue,
                support,
                share,
                rate,
                tail_share,
                tail_rate,
                tail_end,
                amplitude,
                u_min,
                slope_offset,
                slope_tail,
                reach,
                back,
                ahead,
                n_tiles,
                sheet_capacity,
                first_brick,
                n_own,
                n_halo,
                n_halo_slots,
                list_capacity,
                first_vertex,
                first_triangle,
                piece_brick,
                piece_bricks,
                piece_vertex,
                piece_triangle,
                vertex_capacity,
                triangle_capacity,
                zero,
                base_vertex,
                steps_per_angstrom,
                slope_scale,
                n_bricks,
                level,
                tolerance,
                n_kinds,
                arc_reach,
                arc_back,
                arc_ahead
            ),
            host!("BrickRecord", BrickRecord, crossing, layers, neighbours),
            host!("Counters", Counters, list_end, vertices, triangles, flat, checksum, degenerate, sheet_words, bounds),
            host!("Tile", Tile, coord, base, bricks, before, around),
        ]
    }

    /// Returns the differences between the layouts of shaders and host.
    fn differences(shaders: &[StructLayout], host: &[Host]) -> Vec<String> {
        let mut wrong = Vec::new();
        for layout in shaders {
            let Some((_, size, fields)) = host.iter().find(|(name, ..)| *name == layout.name) else {
                wrong.push(format!("{}: unknown on the host", layout.name));
                continue;
            };
            if layout.size != *size {
                wrong.push(format!("{}: {} bytes, {size} on the host", layout.name, layout.size));
            }
            // Neither side has padding between fields, so a field ends where the next begins.
            let ends: Vec<usize> = fields.iter().skip(1).map(|(_, at)| *at).chain([*size]).collect();
            let expected: Vec<_> = fields.iter().zip(ends).map(|((name, at), end)| (*name, *at, end - at)).collect();
            if layout.fields != expected {
                wrong.push(format!("{}: {:?}, {expected:?} on the host", layout.name, layout.fields));
            }
        }
        wrong
    }

    #[test]
    fn structs_have_the_same_layout_on_both_sides() {
        assert_eq!(LAYOUTS.len(), host().len(), "every struct in a buffer is compared");
        assert_eq!(differences(LAYOUTS, &host()), Vec::<String>::new());
        assert_eq!(differences(SPHERE_LAYOUTS, &host()), Vec::<String>::new());
    }

    #[test]
    fn structs_of_pictures_have_the_same_layout_on_both_sides() {
        use crate::picture_targets::{FinishParams, TapUniform, ViewUniform};
        let mut all = vec![
            host!("ViewUniform", ViewUniform, right, up, toward, light, size, offset, scale, reach, diffuse, pad),
            host!(
                "FinishParams",
                FinishParams,
                color,
                background,
                size,
                n_taps,
                line_width,
                falloff,
                bias,
                strength,
                min_light,
                step_min,
                step_max,
                line_strength,
                pad
            ),
            host!("TapUniform", TapUniform, pixels, length),
        ];
        assert_eq!(all.len(), PICTURE_LAYOUTS.len());
        assert_eq!(differences(PICTURE_LAYOUTS, &all), Vec::<String>::new());
        all[2].1 += 4;
        assert!(!differences(PICTURE_LAYOUTS, &all).is_empty());
    }

    #[test]
    fn control_a_moved_field_a_wrong_size_and_an_unknown_struct_are_found() {
        let mut host = host();
        host[0].2[1].1 += 4;
        assert_eq!(differences(LAYOUTS, &host).len(), 1);
        host[1].1 += 16;
        // The size, and the end of the last field.
        assert_eq!(differences(LAYOUTS, &host).len(), 3);
        host.remove(4);
        assert_eq!(differences(LAYOUTS, &host).len(), 4);
    }

    #[test]
    fn shaders_are_in_stage_order() {
        let names: Vec<_> = SHADERS.iter().map(|shader| shader.stage).collect();
        let stages: Vec<_> = Stage::ALL[..8].iter().map(|stage| stage.name()).collect();
        assert_eq!(names, stages);
        assert!(SHADERS.iter().chain(&SPHERE_SHADERS).all(|shader| shader.bindings[0].access == Access::Uniform));
    }
}
