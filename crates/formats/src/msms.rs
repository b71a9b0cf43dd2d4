//! Files of MSMS, in two formats: `.vert` contains the vertices of a mesh and `.face` its triangles. Numbers count from
//! 1, as in MSMS 2.6.
//!
//! Both have two comment lines and a line of counts before their rows. Readers skip lines by their number of fields, so
//! no header line may have as many as a row. MSMS also writes the type of face (contact, toroidal, reentrant) and the
//! number of its analytical face; a mesh has neither, so both are 0. Coordinates have four decimals, MSMS writes three.

use std::io::{self, Write};

use molmesh_surface::Mesh;
use serde_json::Value;

use super::block::Placement;
use super::check::Summary;
use super::error::FormatError;
use super::lines::{Decimals, Line, LineWriter, NORMAL_DECIMALS, largest_coordinate};
use super::{GENERATOR, Meta, Units, text};

/// Half of a mesh in one file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Rows {
    Vertices,
    Faces,
}

/// Layout of an MSMS file.
#[derive(Debug)]
pub(super) struct MsmsPlan {
    header: String,
    /// Upper bound of the file's length, bytes.
    pub(super) len_bound: u64,
    rows: Rows,
}

impl MsmsPlan {
    /// Checks the coordinates and computes the header and the length bound of a `.vert` file.
    pub(super) fn vertices(mesh: &Mesh, summary: &Summary, meta: &Meta) -> Result<Self, FormatError> {
        let extreme = largest_coordinate(mesh, Units::Angstrom, summary)?;
        let sphere = (u64::from(summary.max_atom.unwrap_or_default()) + 1).to_string().len() as u64;
        let position = 3 * (1 + COORDINATES.longest(extreme));
        let row = position + 3 * (1 + NORMAL_DECIMALS.longest(1.0)) + " 0  0\n".len() as u64 + sphere;
        Ok(Self::new(Rows::Vertices, mesh.positions.len(), row, mesh, meta))
    }

    /// Computes the header and the length bound of a `.face` file.
    pub(super) fn faces(mesh: &Mesh, meta: &Meta) -> Self {
        let digits = mesh.positions.len().to_string().len() as u64;
        Self::new(Rows::Faces, mesh.triangles.len(), 3 * (1 + digits) + " 0 0\n".len() as u64, mesh, meta)
    }

    fn new(rows: Rows, n: usize, row: u64, mesh: &Mesh, meta: &Meta) -> Self {
        let header = header(rows, n, mesh, meta);
        let len_bound = header.len() as u64 + row * n as u64;
        Self { header, len_bound, rows }
    }

    /// Writes the file.
    pub(super) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(self.header.as_bytes())?;
        let mut lines = LineWriter::new(out, self.len_bound);
        match self.rows {
            Rows::Vertices => {
                let placement = Placement::new(mesh, Units::Angstrom);
                let atoms = mesh.atom_ids.as_deref();
                for (i, (&position, &normal)) in mesh.positions.iter().zip(mesh.normals.iter()).enumerate() {
                    let sphere = atoms.map_or(0, |atoms| u64::from(atoms[i]) + 1);
                    lines.push(|line| vertex(line, placement.absolute(position), normal, sphere))?;
                }
            }
            Rows::Faces => {
                for &triangle in &mesh.triangles[..] {
                    lines.push(|line| face(line, triangle))?;
                }
            }
        }
        lines.flush()
    }
}

/// Decimals of a coordinate.
const COORDINATES: Decimals = Decimals::of(Units::Angstrom);

/// Returns the three lines of the header. The number of words of the first one is not that of the fields of a row.
fn header(rows: Rows, n: usize, mesh: &Mesh, meta: &Meta) -> String {
    let number = |key: &str| meta.extras.get(key).and_then(Value::as_f64).unwrap_or_default();
    let surface = meta.extras.get("surface").and_then(Value::as_str).map(|name| text::word(Some(name)) + " ");
    let (surface, name) = (surface.unwrap_or_default(), text::word(meta.name.as_deref()));
    let (title, count) = match rows {
        Rows::Vertices => ("vertices", "#vertex"),
        Rows::Faces => ("faces", "#faces"),
    };
    let area = number("area");
    let density = if area > 0.0 { mesh.positions.len() as f64 / area } else { 0.0 };
    let (spheres, probe) = (number("atoms_in_file"), number("probe"));
    format!(
        "# {GENERATOR} {surface}surface {title} of {name}\n{count} #sphere density probe_r\n\
         {n:7} {spheres:7} {density:5.2} {probe:5.2}\n"
    )
}

/// Writes a vertex: position, normal, number of its analytical face, number of the nearest sphere, type of face.
fn vertex(line: &mut Line<'_>, position: [f32; 3], normal: [f32; 3], sphere: u64) {
    line.numbers(position, COORDINATES);
    line.numbers(normal, NORMAL_DECIMALS);
    line.put(b" 0 ");
    line.put(itoa::Buffer::new().format(sphere).as_bytes());
    line.put(b" 0\n");
}

/// Writes a triangle: numbers of its vertices, type of face, number of its analytical face.
fn face(line: &mut Line<'_>, triangle: [u32; 3]) {
    for index in triangle {
        line.separate();
        line.put(itoa::Buffer::new().format(u64::from(index) + 1).as_bytes());
    }
    line.put(b" 0 0\n");
}

#[cfg(test)]
mod tests {
    use super::super::lines::written;
    use super::*;

    #[test]
    fn the_longest_lines_fit() {
        let triangle = written(|line| face(line, [u32::MAX; 3]));
        assert_eq!(triangle, "4294967296 4294967296 4294967296 0 0\n");
        let row = written(|line| vertex(line, [-1e9; 3], [-1.0; 3], 1 << 32));
        let number = "-1000000000.0000";
        assert_eq!(row, format!("{number} {number} {number} -1.0000 -1.0000 -1.0000 0 4294967296 0\n"));
    }

    #[test]
    fn header_lines_have_fewer_fields_than_rows() {
        let Value::Object(extras) = serde_json::json!({
            "surface": "ses", "probe": 1.4, "area": 4.0, "atoms_in_file": 327,
        }) else {
            unreachable!()
        };
        let mesh = Mesh { positions: vec![[0.0; 3]; 37].into(), ..Mesh::default() };
        let meta = Meta { name: Some("a name of\nmany words".into()), extras };
        let header = header(Rows::Vertices, 37, &mesh, &meta);
        let lines: Vec<&str> = header.lines().collect();
        assert_eq!(lines[0], format!("# {GENERATOR} ses surface vertices of a_name_of_many_words"));
        assert_eq!(lines[1..], ["#vertex #sphere density probe_r", "     37     327  9.25  1.40"]);
        assert!(lines.iter().all(|line| line.split_whitespace().count() < 9));
    }
}
