//! VTP: `PolyData` of the VTK XML formats, version 1.0 with 64-bit headers. The XML describes the columns, which follow
//! as raw little-endian blocks after it, each with its length in bytes.
//!
//! Format: VTK documentation, "XML File Formats".

use std::io::{self, Write};

use molmesh_surface::Mesh;

use super::block::{Placement, convert_words, put_floats, write_records};
use super::{Meta, Normals, Storage, text};

/// Bytes of the length before each block.
const LENGTH_BYTES: u64 = 8;
/// End of the file, after the blocks.
const END: &str = "\n  </AppendedData>\n</VTKFile>\n";

/// Layout of a VTP file.
#[derive(Debug)]
pub(super) struct VtpPlan {
    header: String,
    pub(super) len: u64,
    storage: Storage,
    /// Bytes of the integers of triangles.
    index_bytes: u64,
}

/// Columns of a file, in its order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum VtpColumn {
    Normals,
    Colors,
    Atoms,
    /// Number of the part of each triangle.
    Parts,
    Points,
    Connectivity,
    /// End of each triangle in the connectivity.
    Offsets,
}

use VtpColumn::{Atoms, Colors, Connectivity, Normals as NormalColumn, Offsets, Parts, Points};

impl VtpPlan {
    pub(super) fn new(mesh: &Mesh, storage: Storage, meta: &Meta) -> Self {
        let largest = (3 * mesh.triangles.len() as u64).max(mesh.positions.len() as u64);
        let index_bytes = if i32::try_from(largest).is_ok() { 4 } else { 8 };
        let mut plan = Self { header: String::new(), len: 0, storage, index_bytes };
        let mut offset = 0;
        let arrays: Vec<(VtpColumn, String)> = plan
            .columns(mesh)
            .into_iter()
            .map(|column| {
                let array = plan.array(column, offset);
                offset += LENGTH_BYTES + plan.bytes(column, mesh);
                (column, array)
            })
            .collect();
        plan.header = header(mesh, storage, meta, &arrays);
        plan.len = plan.header.len() as u64 + offset + END.len() as u64;
        plan
    }

    /// Returns the columns of the file of a mesh.
    fn columns(&self, mesh: &Mesh) -> Vec<VtpColumn> {
        let optional = [
            (NormalColumn, self.storage.normals == Normals::Smooth),
            (Colors, mesh.colors.is_some()),
            (Atoms, mesh.atom_ids.is_some()),
            (Parts, !mesh.parts.is_empty()),
        ];
        let optional = optional.into_iter().filter(|(_, exists)| *exists).map(|(column, _)| column);
        optional.chain([Points, Connectivity, Offsets]).collect()
    }

    /// Returns the element that describes a column at an offset among the blocks.
    fn array(&self, column: VtpColumn, offset: u64) -> String {
        let index = if self.index_bytes == 4 { "Int32" } else { "Int64" };
        let (kind, name, components) = match column {
            NormalColumn => ("Float32", "Normals", 3),
            Colors => ("UInt8", "RGBA", 4),
            Atoms => ("UInt32", "atom", 1),
            Parts => ("UInt32", "part", 1),
            Points => ("Float32", "Points", 3),
            Connectivity => (index, "connectivity", 1),
            Offsets => (index, "offsets", 1),
        };
        let described = format!("type=\"{kind}\" Name=\"{name}\" NumberOfComponents=\"{components}\"");
        format!("        <DataArray {described} format=\"appended\" offset=\"{offset}\"/>\n")
    }

    /// Returns the length of the block of a column, without its header.
    fn bytes(&self, column: VtpColumn, mesh: &Mesh) -> u64 {
        let (n_vertices, n_triangles) = (mesh.positions.len() as u64, mesh.triangles.len() as u64);
        match column {
            NormalColumn | Points => 12 * n_vertices,
            Colors | Atoms => 4 * n_vertices,
            Parts => 4 * n_triangles,
            Connectivity => 3 * self.index_bytes * n_triangles,
            Offsets => self.index_bytes * n_triangles,
        }
    }

    pub(super) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(self.header.as_bytes())?;
        for column in self.columns(mesh) {
            out.write_all(&self.bytes(column, mesh).to_le_bytes())?;
            match column {
                NormalColumn => rows(out, &mesh.normals, |normal| normal),
                Colors => convert_words(out, mesh.colors.as_deref().unwrap_or_default(), |color| color),
                Atoms => convert_words(out, mesh.atom_ids.as_deref().unwrap_or_default(), u32::to_le_bytes),
                Parts => parts(mesh, out),
                Points => {
                    let placement = Placement::new(mesh, self.storage.units);
                    rows(out, &mesh.positions, |position| placement.absolute(position))
                }
                Connectivity => self.integers(out, 3 * mesh.triangles.len(), |i| {
                    mesh.triangles.as_flattened().get(i).copied().map_or(0, u64::from)
                }),
                Offsets => self.integers(out, mesh.triangles.len(), |i| 3 * (i as u64 + 1)),
            }?;
        }
        out.write_all(END.as_bytes())
    }

    /// Writes `n` integers of triangles.
    fn integers(&self, out: &mut dyn Write, n: usize, value: impl Fn(usize) -> u64) -> io::Result<()> {
        if self.index_bytes == 8 {
            return write_records::<8>(out, n, |range, records| {
                for (record, i) in records.iter_mut().zip(range) {
                    *record = value(i).to_le_bytes();
                }
            });
        }
        write_records::<4>(out, n, |range, records| {
            for (record, i) in records.iter_mut().zip(range) {
                // The lower half of a value that fits 32 bits.
                record.copy_from_slice(&value(i).to_le_bytes()[..4]);
            }
        })
    }
}

/// Writes rows of three numbers.
fn rows(out: &mut dyn Write, rows: &[[f32; 3]], convert: impl Fn([f32; 3]) -> [f32; 3]) -> io::Result<()> {
    convert_words::<12, _>(out, rows, |row| {
        let mut bytes = [0; 12];
        put_floats(&mut bytes, convert(row));
        bytes
    })
}

/// Writes the number of the part of each triangle, from 0.
fn parts(mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
    for (number, part) in (0_u32..).zip(&mesh.parts) {
        write_records::<4>(out, part.triangles.len(), |_, records| records.fill(number.to_le_bytes()))?;
    }
    Ok(())
}

/// Returns the XML up to the first block.
fn header(mesh: &Mesh, storage: Storage, meta: &Meta, arrays: &[(VtpColumn, String)]) -> String {
    let facts = text::facts(mesh, meta, storage.units, None).into_iter();
    let comments: String = facts.flat_map(|fact| ["<!-- ".to_owned(), comment(&fact), " -->\n".to_owned()]).collect();
    let of = |wanted: &[VtpColumn]| -> String {
        arrays.iter().filter(|(column, _)| wanted.contains(column)).map(|(_, array)| array.as_str()).collect()
    };
    let has = |column| arrays.iter().any(|(known, _)| *known == column);
    let scalars = if has(Colors) { " Scalars=\"RGBA\"" } else { "" };
    let normals = if has(NormalColumn) { " Normals=\"Normals\"" } else { "" };
    let (n_points, n_polys) = (mesh.positions.len(), mesh.triangles.len());
    let lines = [
        format!("<?xml version=\"1.0\"?>\n{comments}"),
        "<VTKFile type=\"PolyData\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">\n".to_owned(),
        "  <PolyData>\n".to_owned(),
        format!("    <Piece NumberOfPoints=\"{n_points}\" NumberOfVerts=\"0\" NumberOfLines=\"0\" "),
        format!("NumberOfStrips=\"0\" NumberOfPolys=\"{n_polys}\">\n"),
        format!("      <PointData{scalars}{normals}>\n{}      </PointData>\n", of(&[NormalColumn, Colors, Atoms])),
        format!("      <CellData>\n{}      </CellData>\n", of(&[Parts])),
        format!("      <Points>\n{}      </Points>\n", of(&[Points])),
        format!("      <Polys>\n{}      </Polys>\n", of(&[Connectivity, Offsets])),
        "    </Piece>\n  </PolyData>\n  <AppendedData encoding=\"raw\">\n_".to_owned(),
    ];
    lines.concat()
}

/// Returns a text that cannot end a comment, and that readers which search for tags do not mistake for one.
fn comment(fact: &str) -> String {
    let mut text = String::with_capacity(fact.len());
    for c in fact.chars() {
        match c {
            '<' => text.push('('),
            '>' => text.push(')'),
            '-' if text.ends_with('-') => text.push_str(" -"),
            _ => text.push(c),
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_cannot_be_ended_by_their_text() {
        assert_eq!(comment("a --> <VTKFile ---b"), "a - -) (VTKFile - - -b");
    }
}
