//! The six stages as the build assembled, checked and reflected them.

use wgpu::{BufferBindingType, ShaderStages};

use crate::surface::layout::Params;

/// How a shader uses a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Access {
    Uniform,
    Read,
    Write,
}

/// A buffer of a shader.
#[derive(Debug)]
pub(super) struct Binding {
    /// The variable's name: what decides which buffer is bound.
    pub(super) name: &'static str,
    pub(super) number: u32,
    pub(super) access: Access,
}

/// A stage's shader.
#[derive(Debug)]
pub(super) struct Shader {
    /// The stage's name.
    pub(super) stage: &'static str,
    /// Its text, fragments included.
    pub(super) source: &'static str,
    pub(super) bindings: &'static [Binding],
}

/// A struct that lies in a buffer, as a shader declares it.
#[cfg(test)]
#[derive(Debug)]
pub(super) struct Layout {
    name: &'static str,
    size: usize,
    /// Name, offset, size.
    fields: &'static [(&'static str, usize, usize)],
}

include!(concat!(env!("OUT_DIR"), "/shaders.rs"));

/// Returns the complete WGSL source of every mesh stage, by stage name and in execution order.
pub fn stage_shaders() -> impl Iterator<Item = (&'static str, &'static str)> {
    SHADERS.iter().map(|shader| (shader.stage, shader.source))
}

impl Binding {
    /// The binding as a layout declares it. Parameters are one of several rows of their buffer.
    pub(super) fn layout(&self) -> wgpu::BindGroupLayoutEntry {
        let (ty, rows) = match self.access {
            Access::Uniform => (BufferBindingType::Uniform, true),
            Access::Read => (BufferBindingType::Storage { read_only: true }, false),
            Access::Write => (BufferBindingType::Storage { read_only: false }, false),
        };
        wgpu::BindGroupLayoutEntry {
            binding: self.number,
            visibility: ShaderStages::COMPUTE,
            ty: wgpu::BindingType::Buffer {
                ty,
                has_dynamic_offset: rows,
                min_binding_size: rows.then(|| wgpu::BufferSize::new(size_of::<Params>() as u64)).flatten(),
            },
            count: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::mem::offset_of;

    use super::*;
    use crate::surface::Stage;
    use crate::surface::lattice::LatticeAtom;
    use crate::surface::layout::{Record, Tally, Tile};

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
                n_bricks,
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
                steps_per_angstrom
            ),
            host!("Record", Record, crossing, layers, near),
            host!("Tally", Tally, list_end, vertices, triangles, flat),
            host!("Tile", Tile, coord, base, bricks, before, around),
        ]
    }

    /// What differs between the two sides.
    fn differences(shaders: &[Layout], host: &[Host]) -> Vec<String> {
        let mut wrong = Vec::new();
        for layout in shaders {
            let Some((_, size, fields)) = host.iter().find(|(name, ..)| *name == layout.name) else {
                wrong.push(format!("{}: unknown to the host", layout.name));
                continue;
            };
            if layout.size != *size {
                wrong.push(format!("{}: {} bytes, {size} on the host", layout.name, layout.size));
            }
            // A field ends where the next begins: neither side has room between fields.
            let ends: Vec<usize> = fields.iter().skip(1).map(|(_, at)| *at).chain([*size]).collect();
            let mine: Vec<_> = fields.iter().zip(ends).map(|((name, at), end)| (*name, *at, end - at)).collect();
            if layout.fields != mine {
                wrong.push(format!("{}: {:?}, {mine:?} on the host", layout.name, layout.fields));
            }
        }
        wrong
    }

    #[test]
    fn structs_are_laid_out_alike_on_both_sides() {
        assert_eq!(LAYOUTS.len(), host().len(), "every struct in a buffer is compared");
        assert_eq!(differences(LAYOUTS, &host()), Vec::<String>::new());
    }

    #[test]
    fn the_pictures_structs_are_laid_out_alike_on_both_sides() {
        use crate::gpu::picture_targets::{Numbers, Tap, View};
        let mut all = vec![
            host!("View", View, right, up, toward, light, size, offset, scale, reach, diffuse, pad),
            host!(
                "Numbers", Numbers, color, behind, size, n_taps, line, falloff, bias, strength, darkest, step_from,
                step_to, ink, pad
            ),
            host!("Tap", Tap, pixels, length),
        ];
        assert_eq!(all.len(), PICTURE_LAYOUTS.len());
        assert_eq!(differences(PICTURE_LAYOUTS, &all), Vec::<String>::new());
        all[2].1 += 4;
        assert!(!differences(PICTURE_LAYOUTS, &all).is_empty());
    }

    #[test]
    fn a_moved_field_a_wrong_size_and_an_unknown_struct_are_found() {
        let mut host = host();
        host[0].2[1].1 += 4;
        assert_eq!(differences(LAYOUTS, &host).len(), 1);
        host[1].1 += 16;
        // The size itself, and the last field's end.
        assert_eq!(differences(LAYOUTS, &host).len(), 3);
        host.remove(4);
        assert_eq!(differences(LAYOUTS, &host).len(), 4);
    }

    #[test]
    fn every_stage_has_its_shader_in_order() {
        let names: Vec<_> = SHADERS.iter().map(|shader| shader.stage).collect();
        let stages: Vec<_> = Stage::ALL[..6].iter().map(|stage| stage.name()).collect();
        assert_eq!(names, stages);
        assert!(SHADERS.iter().all(|shader| shader.bindings[0].access == Access::Uniform));
    }
}
