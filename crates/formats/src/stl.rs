//! STL, binary: an 80-byte header, a count, then 50 bytes per triangle. It has no shared vertices, colours or
//! vertex normals, only the normals of the flat triangles.

use std::io::{self, Write};

use molmesh_surface::vector::{area_vector, length};
use molmesh_surface::{Exceeded, Limit, Mesh};

use super::block::{Placement, put_floats, write_records};
use super::error::FormatError;
use super::{GENERATOR, Meta, Units, text};

const HEADER_BYTES: usize = 80;
/// Normal, three corners, and an attribute that is 0.
const TRIANGLE_BYTES: usize = 50;

/// Layout of an STL file.
#[derive(Debug)]
pub(super) struct StlPlan {
    /// Header and count.
    head: [u8; HEADER_BYTES + 4],
    pub(super) len: u64,
    units: Units,
}

impl StlPlan {
    pub(super) fn new(mesh: &Mesh, units: Units, meta: &Meta) -> Result<Self, FormatError> {
        let triangles = mesh.triangles.len();
        let limit = Exceeded::new(Limit::FileTriangles, u32::MAX.into());
        let error = |_overflow| Exceeded { actual: Some(triangles as u64), ..limit }.error::<FormatError>();
        let count = u32::try_from(triangles).map_err(error)?;
        let mut head = [b' '; HEADER_BYTES + 4];
        // A header that begins with "solid" marks a text STL; some programs read colours after "COLOR=".
        let words =
            format!("{GENERATOR} units={} {}", units.name(), text::word(meta.name.as_deref()).replace('=', "_"));
        let words = &words.as_bytes()[..words.len().min(HEADER_BYTES)];
        head[..words.len()].copy_from_slice(words);
        head[HEADER_BYTES..].copy_from_slice(&count.to_le_bytes());
        Ok(Self { head, len: (HEADER_BYTES + 4) as u64 + TRIANGLE_BYTES as u64 * u64::from(count), units })
    }

    pub(super) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(&self.head)?;
        let placement = Placement::new(mesh, self.units);
        let (positions, triangles) = (&mesh.positions[..], &mesh.triangles[..]);
        write_records::<TRIANGLE_BYTES>(out, triangles.len(), |range, records| {
            for (record, triangle) in records.iter_mut().zip(&triangles[range]) {
                let corners = triangle.map(|v| positions[v as usize]);
                let (floats, attribute) = record.as_chunks_mut::<12>();
                put_floats(&mut floats[0], face_normal(corners));
                for (bytes, corner) in floats[1..].iter_mut().zip(corners) {
                    put_floats(bytes, placement.absolute(corner));
                }
                attribute.fill(0);
            }
        })
    }
}

/// Returns the unit normal of a triangle by the right-hand rule; zero without area, as STL readers expect.
#[inline]
#[expect(clippy::cast_possible_truncation, reason = "STL requires f32")]
fn face_normal(corners: [[f32; 3]; 3]) -> [f32; 3] {
    // Double precision: the cross product of two edges of 1e-10 Å would underflow in single precision.
    let n = area_vector(corners.map(|p| p.map(f64::from)));
    let length = length(n);
    let scale = if length > 0.0 { length.recip() } else { 0.0 };
    n.map(|v| (v * scale) as f32)
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "these normals are exact")]
mod tests {
    use super::*;

    #[test]
    fn normals_follow_the_winding_and_degenerate_triangles_have_none() {
        let (o, x, y) = ([0.0; 3], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0]);
        assert_eq!(face_normal([o, x, y]), [0.0, 0.0, 1.0]);
        assert_eq!(face_normal([o, y, x]), [0.0, 0.0, -1.0]);
        assert_eq!(face_normal([o, x, x]), [0.0; 3]);
        let tiny = 1e-15;
        assert_eq!(face_normal([o, [tiny, 0.0, 0.0], [0.0, tiny, 0.0]]), [0.0, 0.0, 1.0]);
    }

    #[test]
    fn the_header_never_marks_text_or_colours() {
        for name in ["solid", "COLOR=rgba", "a very long name ".repeat(20).as_str(), ""] {
            let meta = Meta { name: Some(name.to_owned()), ..Meta::default() };
            let plan = StlPlan::new(&Mesh::default(), Units::Nanometer, &meta).unwrap();
            assert!(plan.head.starts_with(b"molmesh "));
            assert!(!plan.head.windows(6).any(|w| w == b"COLOR="));
            assert_eq!(plan.head[HEADER_BYTES..], [0; 4]);
        }
    }
}
