//! PLY as text: the header of the binary format, then one line per vertex and triangle.
//!
//! Numbers are rounded as in OBJ. Vertices with equal coordinates stay separate, so the surface stays closed.

use std::io::{self, Write};

use molmesh_surface::Mesh;

use super::block::Placement;
use super::check::Summary;
use super::error::FormatError;
use super::lines::{Decimals, Line, LineWriter, NORMAL_DECIMALS, largest_coordinate};
use super::ply::header;
use super::{Meta, Normals, Storage};

/// Layout of a text PLY file.
#[derive(Debug)]
pub(super) struct PlyTextPlan {
    header: String,
    /// Upper bound of the file's length, bytes.
    pub(super) len_bound: u64,
    storage: Storage,
}

impl PlyTextPlan {
    /// Checks the coordinates and computes the header and the length bound.
    pub(super) fn new(mesh: &Mesh, storage: Storage, summary: &Summary, meta: &Meta) -> Result<Self, FormatError> {
        let decimals = Decimals::of(storage.units);
        let extreme = largest_coordinate(mesh, storage.units, summary)?;
        let header = header(mesh, storage, meta, "ascii", Some(&decimals.precision()));
        let (n_vertices, n_triangles) = (mesh.positions.len() as u64, mesh.triangles.len() as u64);
        let digits = |largest: u64| 1 + largest.to_string().len() as u64;
        let normal = if storage.normals == Normals::Smooth { 3 * (1 + NORMAL_DECIMALS.longest(1.0)) } else { 0 };
        let color = if mesh.colors.is_some() { 4 * digits(u64::from(u8::MAX)) } else { 0 };
        let atom = summary.max_atom.map_or(0, |atom| digits(u64::from(atom)));
        let vertex = 3 * (1 + decimals.longest(extreme)) + normal + color + atom;
        let face = "3\n".len() as u64 + 3 * digits(n_vertices);
        let len_bound = header.len() as u64 + vertex * n_vertices + face * n_triangles;
        Ok(Self { header, len_bound, storage })
    }

    /// Writes the file.
    pub(super) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(self.header.as_bytes())?;
        let mut lines = LineWriter::new(out, self.len_bound);
        let Storage { normals, units, .. } = self.storage;
        let (placement, decimals) = (Placement::new(mesh, units), Decimals::of(units));
        let normals = (normals == Normals::Smooth).then_some(&mesh.normals[..]);
        let (colors, atoms) = (mesh.colors.as_deref(), mesh.atom_ids.as_deref());
        for (i, &position) in mesh.positions.iter().enumerate() {
            lines.push(|line| {
                line.numbers(placement.absolute(position), decimals);
                if let Some(normals) = normals {
                    line.numbers(normals[i], NORMAL_DECIMALS);
                }
                if let Some(colors) = colors {
                    for level in colors[i] {
                        integer(line, u32::from(level));
                    }
                }
                if let Some(atoms) = atoms {
                    integer(line, atoms[i]);
                }
                end(line);
            })?;
        }
        for &triangle in &mesh.triangles[..] {
            lines.push(|line| {
                line.put(b"3");
                for index in triangle {
                    integer(line, index);
                }
                end(line);
            })?;
        }
        lines.flush()
    }
}

/// Appends an integer.
fn integer(line: &mut Line<'_>, value: u32) {
    line.separate();
    line.put(itoa::Buffer::new().format(value).as_bytes());
}

/// Ends a line.
fn end(line: &mut Line<'_>) {
    line.put(b"\n");
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    #[test]
    fn the_longest_lines_fit_and_are_within_the_bound() {
        let vertex = [-1e9 + 64.0; 3];
        let mesh = Mesh {
            centre: vertex,
            positions: vec![[0.0; 3]].into(),
            normals: vec![[-1.0; 3]].into(),
            colors: Some(vec![[255; 4]].into()),
            atom_ids: Some(vec![u32::MAX].into()),
            triangles: vec![[u32::MAX; 3]].into(),
            ..Mesh::default()
        };
        let summary = Summary { bounds: [[0.0; 3]; 2], max_atom: Some(u32::MAX), translucent: false, open: false };
        let storage = Storage { units: super::super::Units::Angstrom, ..Storage::default() };
        let plan = PlyTextPlan::new(&mesh, storage, &summary, &Meta::default()).unwrap();
        let mut bytes = Vec::new();
        plan.write(&mesh, &mut bytes).unwrap();
        let text = String::from_utf8(bytes).unwrap();
        let (header, records) = text.split_once("end_header\n").unwrap();
        assert!(header.starts_with("ply\nformat ascii 1.0\n") && header.contains("comment precision 0.0001\n"));
        let expected = format!(
            "{p} {p} {p} -1.0000 -1.0000 -1.0000 255 255 255 255 4294967295\n3 4294967295 4294967295 4294967295\n",
            p = "-999999936.0000"
        );
        assert_eq!(records, expected);
        // The index in the triangle is invalid and longer than the bound of a valid one.
        assert!(text.len() as u64 <= plan.len_bound + 27, "{} of {}", text.len(), plan.len_bound);
    }
}
