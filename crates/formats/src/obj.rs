//! Wavefront OBJ: text, one line per vertex, normal and triangle; indices count from 1. Colours follow the
//! coordinates of a vertex, an extension that most programs read.
//!
//! Coordinates are rounded to 1e-4 Å (five decimals in nanometres), a tenth of the precision of structure files.
//! Vertices closer than that may get equal coordinates; they stay separate vertices, and the surface stays closed.

use std::io::{self, Write};

use molmesh_surface::Mesh;

use super::block::Placement;
use super::check::Summary;
use super::error::FormatError;
use super::lines::{Decimals, Line, LineWriter, NORMAL_DECIMALS, largest_coordinate};
use super::{Meta, Normals, Storage, Units, text};

/// Decimals of a colour component.
const COLOR_DECIMALS: Decimals = Decimals::Four;

/// Layout of an OBJ file.
#[derive(Debug)]
pub(super) struct ObjPlan {
    header: String,
    /// Line that begins the group of each part.
    groups: Vec<String>,
    /// Upper bound of the file's length, bytes.
    pub(super) len_bound: u64,
    storage: Storage,
}

impl ObjPlan {
    /// Checks the coordinates and computes the header and the length bound.
    pub(super) fn new(mesh: &Mesh, storage: Storage, summary: &Summary, meta: &Meta) -> Result<Self, FormatError> {
        let (smooth, decimals) = (storage.normals == Normals::Smooth, Decimals::of(storage.units));
        let extreme = largest_coordinate(mesh, storage.units, summary)?;
        let header = header(mesh, storage.units, meta);
        let (n_vertices, n_triangles) = (mesh.positions.len() as u64, mesh.triangles.len() as u64);
        let color = if mesh.colors.is_some() { 3 * " 0.0000".len() as u64 } else { 0 };
        let vertex = "v   \n".len() as u64 + 3 * decimals.longest(extreme) + color;
        let normal = if smooth { "vn   \n".len() as u64 + 3 * NORMAL_DECIMALS.longest(1.0) } else { 0 };
        let digits = n_vertices.to_string().len() as u64;
        let face = if smooth { "f //  //  //\n".len() as u64 + 6 * digits } else { "f   \n".len() as u64 + 3 * digits };
        let groups: Vec<String> =
            mesh.parts.iter().map(|part| format!("g {}\n", text::word(Some(&part.name)))).collect();
        let of_groups = groups.iter().map(|line| line.len() as u64).sum::<u64>();
        let len_bound = header.len() as u64 + (vertex + normal) * n_vertices + face * n_triangles + of_groups;
        Ok(Self { header, groups, len_bound, storage })
    }

    /// Writes the file.
    pub(super) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(self.header.as_bytes())?;
        let mut lines = LineWriter::new(out, self.len_bound);
        let Storage { normals, units, .. } = self.storage;
        let (placement, decimals) = (Placement::new(mesh, units), Decimals::of(units));
        match mesh.colors.as_deref() {
            None => {
                for &position in &mesh.positions[..] {
                    lines.push(|line| vector(line, b"v", placement.absolute(position), decimals))?;
                }
            }
            Some(colors) => {
                for (&position, &color) in mesh.positions.iter().zip(colors) {
                    lines.push(|line| colored(line, placement.absolute(position), decimals, color))?;
                }
            }
        }
        let smooth = normals == Normals::Smooth;
        for &normal in mesh.normals.iter().filter(|_| smooth) {
            lines.push(|line| vector(line, b"vn", normal, NORMAL_DECIMALS))?;
        }
        let whole = mesh.parts.is_empty().then_some((None, 0..mesh.triangles.len()));
        let ranges = mesh.parts.iter().map(|part| part.triangles.clone());
        for (group, triangles) in self.groups.iter().map(Some).zip(ranges).chain(whole) {
            if let Some(group) = group.filter(|_| !triangles.is_empty()) {
                lines.text(group)?;
            }
            for &triangle in &mesh.triangles[triangles] {
                lines.push(|line| face(line, triangle, smooth))?;
            }
        }
        lines.flush()
    }
}

fn header(mesh: &Mesh, units: Units, meta: &Meta) -> String {
    let facts = text::facts(mesh, meta, units, Some(&Decimals::of(units).precision()));
    let mut header: String = facts.into_iter().flat_map(|fact| ["# ".to_owned(), fact, "\n".to_owned()]).collect();
    header += "o ";
    header += &text::word(meta.name.as_deref());
    header += "\n";
    header
}

/// Writes a keyword and three numbers.
fn vector(line: &mut Line<'_>, keyword: &[u8], row: [f32; 3], decimals: Decimals) {
    line.put(keyword);
    line.numbers(row, decimals);
    line.put(b"\n");
}

/// Writes a vertex with its colour, sRGB from 0 to 1.
fn colored(line: &mut Line<'_>, row: [f32; 3], decimals: Decimals, [r, g, b, _]: [u8; 4]) {
    line.put(b"v");
    line.numbers(row, decimals);
    line.numbers([r, g, b].map(|level| f32::from(level) / 255.0), COLOR_DECIMALS);
    line.put(b"\n");
}

/// Writes a triangle. If `smooth`, its vertices have the normals of the same index.
fn face(line: &mut Line<'_>, triangle: [u32; 3], smooth: bool) {
    line.put(b"f");
    let mut digits = itoa::Buffer::new();
    for index in triangle {
        let number = digits.format(u64::from(index) + 1).as_bytes();
        line.put(b" ");
        line.put(number);
        if smooth {
            line.put(b"//");
            line.put(number);
        }
    }
    line.put(b"\n");
}

#[cfg(test)]
mod tests {
    use super::super::lines::written;
    use super::*;

    #[test]
    fn the_longest_lines_fit() {
        let triangle = written(|line| face(line, [u32::MAX; 3], true));
        assert_eq!(triangle, format!("f{}\n", " 4294967296//4294967296".repeat(3)));
        let normal = written(|line| vector(line, b"vn", [-1e9; 3], Decimals::Five));
        assert_eq!(normal, format!("vn{}\n", " -1000000000.00000".repeat(3)));
        let vertex = written(|line| colored(line, [-1e9; 3], Decimals::Five, [255, 0, 10, 255]));
        assert_eq!(vertex, format!("v{} 1.0000 0.0000 0.0392\n", " -1000000000.00000".repeat(3)));
    }

    #[test]
    fn too_large_coordinates_are_rejected() {
        let mesh = Mesh { centre: [0.0, -2e9, 0.0], positions: vec![[0.0; 3]].into(), ..Mesh::default() };
        let summary = Summary { bounds: [[0.0; 3]; 2], max_atom: None, translucent: false, open: false };
        let plan = |storage: Storage| ObjPlan::new(&mesh, storage, &summary, &Meta::default());
        let error = plan(Storage::default()).unwrap_err();
        assert_eq!(error, FormatError::CoordinateTooLarge { value: -2e9, limit: 1e9 });
        assert!(plan(Storage { units: Units::Nanometer, ..Storage::default() }).is_ok());
    }
}
