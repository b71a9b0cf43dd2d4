//! Colours of atoms by the parameters `color`, `palette` and `color_range`. A vertex has the colour of the atom whose
//! sphere is nearest to it.

mod blend;
mod depth;
mod of_blocks;
mod of_map;
mod of_mesh;
mod palette;
mod scheme;
mod tables;
mod vertex;

use std::collections::HashSet;

use indexmap::IndexSet;
use rayon::prelude::*;
use serde::Serialize;
use thiserror::Error;

pub use blend::ColorBlend;
pub(super) use of_blocks::BlockColors;
pub(super) use of_mesh::MeshColors;
pub use palette::Palette;
pub use scheme::{EXPECTED, Hydrophobicity, Scheme};
pub(super) use vertex::MeshedSurface;
pub use vertex::VertexProperty;

use molmesh_structure::annotations::{Confidences, SecondaryRanges};
use molmesh_structure::{KindSet, Structure, element};
use molmesh_surface::Column;
use of_blocks::{number, without_entities};
use palette::Rgb;
use tables::{OTHER, PLDDT};

/// Vertices per task.
const ROWS: usize = 1 << 16;
/// Maximum number of entries of a legend.
const MAX_ENTRIES: usize = 100;
/// Number of values in the legend of a palette.
const STOPS: u32 = 5;

/// Parameters of the colours of a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Coloring {
    /// Scheme.
    pub scheme: Scheme,
    /// Palette of a numeric scheme; the default of the scheme if `None`.
    pub palette: Option<Palette>,
    /// Values at the ends of the palette; the default of the scheme if `None`.
    pub range: Option<[f64; 2]>,
    /// Transition between the colours of neighbouring vertices.
    pub blend: ColorBlend,
    /// Distance from the surface, along the normal of a vertex, at which a map is sampled, Å.
    pub offset: f64,
}

impl Coloring {
    /// Returns a canonical text of the parameters, equal for equal colours.
    #[must_use]
    pub fn canonical(&self) -> String {
        let palette = self.palette.or(self.scheme.palette()).map_or("", Palette::name);
        let blend = self.blend.name();
        let offset = if self.scheme.needs_map() { format!("&color_offset={}", self.offset) } else { String::new() };
        format!("color={}&palette={palette}&color_range={:?}&color_blend={blend}{offset}", self.scheme, self.range)
    }
}

/// Entry of a legend.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct LegendEntry {
    /// Value, or name of the element, chain, entity, residue or pLDDT class.
    pub label: String,
    /// Colour, `#rrggbb`, sRGB.
    pub color: String,
}

/// Colours of a mesh.
#[derive(Debug, Clone, Default, Serialize, utoipa::ToSchema)]
pub struct ColorReport {
    /// Scheme, the value of the parameter `color`.
    pub scheme: String,
    /// Palette of a numeric scheme; absent for other schemes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub palette: Option<&'static str>,
    /// Values at the ends of the palette of a numeric scheme; absent for other schemes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub range: Option<[f64; 2]>,
    /// `smooth` if the colours are blended; absent otherwise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub blend: Option<&'static str>,
    /// Source of the values of `plddt`: `ma_qa_metric_local`, the table of `ModelCIF`, or `b_factor`; absent for other
    /// schemes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<&'static str>,
    /// Map of the scheme `map`; absent for other schemes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub map: Option<MapReport>,
    /// Colours of five equidistant values, or of the categories that occur, at most 100.
    pub legend: Vec<LegendEntry>,
}

/// Map whose values colour a mesh.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct MapReport {
    /// File format: `ccp4` (also MRC) or `dx`.
    pub format: &'static str,
    /// Number of points along each axis of the file.
    pub size: [usize; 3],
    /// Distance from the surface at which the map was sampled in Å.
    pub offset: f64,
    /// Vertices that are grey, because the map has no value there.
    pub vertices_outside: u64,
}

/// The structure lacks the values of a scheme.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("parameter `color`: `{scheme}` cannot be applied: {why}; expected one of {EXPECTED}")]
pub struct ColorError {
    /// Name of the scheme.
    pub scheme: String,
    /// Reason.
    pub why: String,
}

impl ColorError {
    /// Returns the error of a request without a map.
    pub(super) fn without_map(scheme: Scheme) -> Self {
        let why = "it needs a map: send one as the part `map` of a form, or use --map on the command line";
        Self { scheme: scheme.to_string(), why: why.to_owned() }
    }

    /// Returns the error of a job without a search for pockets.
    pub(super) fn without_pockets(scheme: Scheme) -> Self {
        Self { scheme: scheme.to_string(), why: "it needs a search for pockets: set pockets=true".to_owned() }
    }

    /// Returns the error of a map that no colour needs.
    pub(super) fn unused_map(scheme: Option<Scheme>) -> Self {
        let scheme = scheme.map_or_else(|| "none".to_owned(), |scheme| scheme.to_string());
        Self { scheme, why: "it does not use the map that was sent; set color=map".to_owned() }
    }
}

/// Colours of the atoms of a structure.
pub struct AtomColors<'a> {
    structure: &'a Structure,
    scheme: Scheme,
    palette: Palette,
    /// Range of the values that are coloured.
    pub(crate) range: [f64; 2],
    /// Colours by residue name, by chain, or of entities by `label_chain`.
    colors: Vec<Rgb>,
    /// Values by residue name.
    values: Vec<Option<f64>>,
    /// Helices and strands.
    secondary: Option<SecondaryRanges>,
    /// Confidences in a table of the file.
    confidences: Option<Confidences<'a>>,
    /// Factor that converts B-factors to pLDDT from 0 to 100; `None` if they cannot be pLDDT.
    plddt_scale: Option<f64>,
}

impl<'a> AtomColors<'a> {
    /// Prepares the colours of all atoms. `selected` are the atoms that the default range and the legend describe.
    ///
    /// # Errors
    /// Returns a [`ColorError`] if the file lacks the values of the scheme, or the scheme is of vertices.
    pub fn new(structure: &'a Structure, selected: &[u32], coloring: &Coloring) -> Result<Self, ColorError> {
        let mut names = IndexSet::new();
        let colors = Self::numbered(structure, selected, coloring, &mut names)?;
        if coloring.scheme == Scheme::Entity && names.is_empty() {
            return Err(without_entities());
        }
        Ok(colors)
    }

    /// Prepares the colours as [`Self::new`] does. Chains or entities have the numbers of their names in `names`, which
    /// are in order of first appearance; adds those of this structure.
    fn numbered(
        structure: &'a Structure,
        selected: &[u32],
        coloring: &Coloring,
        names: &mut IndexSet<String>,
    ) -> Result<Self, ColorError> {
        let Coloring { scheme, palette, range, .. } = *coloring;
        let fail = |why: String| ColorError { scheme: scheme.to_string(), why };
        if matches!(scheme, Scheme::Vertex(_)) {
            return Err(fail("it colours vertices, not atoms".to_owned()));
        }
        let residues = || structure.residue.texts();
        let values = match scheme {
            Scheme::Hydrophobicity(scale) => {
                residues().map(|name| Some(tables::hydrophobicity(name)?[scale as usize])).collect()
            }
            Scheme::Charge => residues().map(tables::charge).collect(),
            _ => Vec::new(),
        };
        let colors = match scheme {
            Scheme::Residue => residues().map(tables::residue).collect(),
            Scheme::Chain => structure.chain.texts().map(|name| tables::category(number(names, name))).collect(),
            Scheme::Entity if structure.label_chain.is_empty() => return Err(without_entities()),
            Scheme::Entity => {
                let color = |name: &String| match name.as_str() {
                    "" => OTHER,
                    name => tables::category(number(names, name)),
                };
                structure.entities.iter().map(color).collect()
            }
            _ => Vec::new(),
        };
        let secondary = (scheme == Scheme::SecondaryStructure).then(|| SecondaryRanges::of(structure)).flatten();
        if scheme == Scheme::SecondaryStructure && secondary.is_none() {
            let why = "the file describes no helices and strands (HELIX and SHEET records of PDB, or struct_conf and \
                       struct_sheet_range of mmCIF); none are computed";
            return Err(fail(why.to_owned()));
        }
        let confidences = (scheme == Scheme::Plddt).then(|| Confidences::of(structure, selected)).flatten();
        let plddt_scale = match (scheme == Scheme::Plddt).then(|| plddt_scale(structure)) {
            Some(Err(why)) if confidences.is_none() => return Err(fail(why)),
            scale => scale.and_then(Result::ok),
        };
        let column = match scheme {
            Scheme::BFactor => Some(&structure.b_factor),
            Scheme::Occupancy => Some(&structure.occupancy),
            _ => None,
        };
        let range = range.or(scheme.range()).or_else(|| Some(range_of(column?, selected))).unwrap_or_default();
        let palette = palette.or(scheme.palette()).unwrap_or(Palette::Viridis);
        Ok(Self { structure, scheme, palette, range, colors, values, secondary, confidences, plddt_scale })
    }

    /// Returns the colour of atom `i`, sRGB and opaque.
    #[must_use]
    pub fn of(&self, i: usize) -> [u8; 4] {
        opaque(self.rgb(i))
    }

    fn rgb(&self, i: usize) -> Rgb {
        let structure = self.structure;
        match self.scheme {
            Scheme::Uniform(color) => color,
            // Rejected by [`Self::new`].
            Scheme::Vertex(_) => OTHER,
            Scheme::Element => tables::element(structure.element[i]),
            Scheme::Chain => self.colors[structure.chain.id(i) as usize],
            Scheme::Entity => self.colors[structure.label_chain.id(i) as usize],
            Scheme::Residue => self.colors[structure.residue.id(i) as usize],
            Scheme::BFactor => self.scaled(f64::from(structure.b_factor[i])),
            Scheme::Occupancy => self.scaled(f64::from(structure.occupancy[i])),
            Scheme::SecondaryStructure => self.secondary(i).1,
            Scheme::Plddt => self.plddt(i).map_or(OTHER, |value| PLDDT[plddt_class(value)].2),
            Scheme::Hydrophobicity(_) | Scheme::Charge => {
                self.values[structure.residue.id(i) as usize].map_or(OTHER, |value| self.scaled(value))
            }
        }
    }

    fn scaled(&self, value: f64) -> Rgb {
        scaled(self.palette, self.range, value)
    }

    /// Returns label and colour of the secondary structure of atom `i`.
    fn secondary(&self, i: usize) -> (&'static str, Rgb) {
        tables::secondary(self.secondary.as_ref().and_then(|ranges| ranges.get(self.structure, i)))
    }

    /// Returns the pLDDT of atom `i`, 0 to 100. The table of a file may lack ligands, whose B-factors then count.
    fn plddt(&self, i: usize) -> Option<f64> {
        let of_table = self.confidences.as_ref().map(|confidences| confidences.get(self.structure, i));
        match of_table {
            Some(Some(value)) => Some(value),
            Some(None) if KindSet::POLYMER.has(self.structure.kind[i]) => None,
            _ => self.plddt_scale.map(|scale| f64::from(self.structure.b_factor[i]) * scale),
        }
    }

    /// Returns the scheme, the range and the legend of the `selected` atoms.
    #[must_use]
    pub fn report(&self, selected: &[u32]) -> ColorReport {
        let legend = match self.scheme {
            Scheme::Uniform(_) => Vec::new(),
            Scheme::Plddt => PLDDT.iter().map(|(_, label, color)| entry((*label).to_owned(), *color)).collect(),
            _ if self.scheme.palette().is_some() => stops(self.palette, self.range, round),
            _ => self.categories(selected).into_iter().map(|(label, color)| entry(label, color)).collect(),
        };
        let has_numbers = self.scheme.palette().is_some();
        let source = (self.scheme == Scheme::Plddt)
            .then(|| if self.confidences.is_some() { "ma_qa_metric_local" } else { "b_factor" });
        ColorReport {
            scheme: self.scheme.to_string(),
            source,
            palette: has_numbers.then(|| self.palette.name()),
            range: has_numbers.then_some(self.range),
            legend,
            ..ColorReport::default()
        }
    }

    /// Returns the categories of the `selected` atoms with their colours, in order of first appearance.
    fn categories(&self, selected: &[u32]) -> Vec<(String, Rgb)> {
        let structure = self.structure;
        let mut seen = HashSet::new();
        let mut found = Vec::new();
        for i in selected.iter().map(|&i| i as usize) {
            let id = match self.scheme {
                Scheme::Element => u32::from(structure.element[i]),
                Scheme::Residue => structure.residue.id(i),
                Scheme::Entity => structure.label_chain.id(i),
                Scheme::SecondaryStructure => self.secondary(i).1,
                _ => structure.chain.id(i),
            };
            if found.len() == MAX_ENTRIES || !seen.insert(id) {
                continue;
            }
            let label = match self.scheme {
                Scheme::Element => {
                    usize::from(structure.element[i]).checked_sub(1).map_or("?", |z| element::SYMBOLS[z])
                }
                Scheme::Residue => structure.residue.get(i),
                Scheme::SecondaryStructure => self.secondary(i).0,
                Scheme::Entity => {
                    structure.entities.get(id as usize).filter(|name| !name.is_empty()).map_or("?", String::as_str)
                }
                _ => structure.chain.get(i),
            };
            // Several chains may belong to one entity.
            if self.scheme != Scheme::Entity || !found.iter().any(|(known, _)| known == label) {
                found.push((label.to_owned(), self.rgb(i)));
            }
        }
        found
    }
}

/// Returns the colour of each vertex by its index of an atom or its value.
fn of_vertices<T: Copy + Sync>(rows: &[T], color: impl Fn(T) -> [u8; 4] + Sync) -> Column<[u8; 4]> {
    let mut column = Column::zeroed(rows.len());
    column.par_chunks_mut(ROWS).zip(rows.par_chunks(ROWS)).for_each(|(out, rows)| {
        out.iter_mut().zip(rows).for_each(|(out, &row)| *out = color(row));
    });
    column
}

/// Returns the colour of a value. In an empty range, all values have the colour of the palette's middle.
fn scaled(palette: Palette, [low, high]: [f64; 2], value: f64) -> Rgb {
    palette.at(if high > low { (value - low) / (high - low) } else { 0.5 })
}

/// Returns the legend of a numeric scheme: equidistant values, rounded by `round`.
fn stops(palette: Palette, range: [f64; 2], round: impl Fn(f64) -> f64) -> Vec<LegendEntry> {
    let [low, high] = range;
    let value = |stop: u32| round(low + (high - low) * f64::from(stop) / f64::from(STOPS - 1));
    (0..STOPS).map(value).map(|value| entry(value.to_string(), scaled(palette, range, value))).collect()
}

/// Returns a colour with its alpha, sRGB.
fn opaque(color: Rgb) -> [u8; 4] {
    let [_, r, g, b] = color.to_be_bytes();
    [r, g, b, u8::MAX]
}

fn entry(label: String, color: Rgb) -> LegendEntry {
    LegendEntry { label, color: format!("#{color:06x}") }
}

/// Returns the class of a pLDDT from 0 to 100.
fn plddt_class(value: f64) -> usize {
    PLDDT.iter().position(|(bound, ..)| value <= *bound).unwrap_or(PLDDT.len() - 1)
}

/// Returns the factor that converts the B-factors of a predicted structure to pLDDT from 0 to 100. Some programs write
/// pLDDT from 0 to 1.
fn plddt_scale(structure: &Structure) -> Result<f64, String> {
    let [low, high] = extremes(structure.b_factor.iter().copied());
    if low < 0.0 || high <= 0.0 || high > 100.0 {
        return Err(format!("the B-factors are {low} to {high}, but pLDDT ranges from 0 to 100, or from 0 to 1"));
    }
    Ok(if high <= 1.0 { 100.0 } else { 1.0 })
}

/// Returns the lowest and the highest value of the `selected` atoms, to three decimals.
fn range_of(column: &[f32], selected: &[u32]) -> [f64; 2] {
    extremes(selected.iter().map(|&i| column[i as usize])).map(round)
}

fn extremes(values: impl Iterator<Item = f32>) -> [f64; 2] {
    let all = values.map(f64::from).fold([f64::MAX, f64::MIN], |[low, high], v| [low.min(v), high.max(v)]);
    if all[0] > all[1] { [0.0; 2] } else { all }
}

fn round(value: f64) -> f64 {
    (value * 1e3).round() / 1e3
}

#[cfg(test)]
mod tests {
    use molmesh_structure::{ReadLimits, read};
    use molmesh_surface::{Control, CpuBackend};

    use super::*;
    use crate::{Choice, JobError, JobLimits, Product, params, run};

    /// Two chains of the entity 1, a sulphate of the entity 2, and a water of an unknown entity.
    const CIF: &str = "data_x
loop_
_struct_asym.id
_struct_asym.entity_id
A 1
B 1
C 2
loop_
_atom_site.group_PDB
_atom_site.type_symbol
_atom_site.label_atom_id
_atom_site.label_comp_id
_atom_site.label_asym_id
_atom_site.auth_asym_id
_atom_site.B_iso_or_equiv
_atom_site.occupancy
_atom_site.Cartn_x
_atom_site.Cartn_y
_atom_site.Cartn_z
ATOM C CA LYS A H 40.0 1.0 0 0 0
ATOM O OD1 ASP B L 55.0 0.5 4 0 0
ATOM N N MSE B L 90.0 1.0 8 0 0
HETATM S S SO4 C H 100.0 1.0 12 0 0
HETATM Xx X XYZ D W 71.0 1.0 16 0 0
";

    fn structure(text: &str) -> Structure {
        read(text.as_bytes(), &ReadLimits::default()).unwrap()
    }

    fn coloring(pairs: &[(&str, &str)]) -> Coloring {
        params::parse(pairs.iter().copied()).unwrap().options.color.unwrap()
    }

    const ALL: [u32; 5] = [0, 1, 2, 3, 4];

    fn colors(structure: &Structure, pairs: &[(&str, &str)]) -> Vec<String> {
        let colors = AtomColors::new(structure, &ALL, &coloring(pairs)).unwrap();
        (0..structure.len()).map(|i| format!("{:06x}", colors.rgb(i))).collect()
    }

    #[test]
    fn every_scheme_gives_the_colours_of_its_source() {
        let structure = structure(CIF);
        let found = |scheme: &str| colors(&structure, &[("color", scheme)]);
        assert_eq!(found("uniform:#102030"), ["102030"; 5]);
        assert_eq!(found("element"), ["909090", "ff0d0d", "3050f8", "ffff30", "b0b0b0"]);
        assert_eq!(found("chain"), ["4fa59b", "e08e5a", "e08e5a", "4fa59b", "7f8fd0"]);
        assert_eq!(found("entity"), ["4fa59b", "4fa59b", "4fa59b", "e08e5a", "b0b0b0"]);
        assert_eq!(found("residue"), ["145aff", "e60a0a", "e6e600", "b0b0b0", "b0b0b0"]);
        assert_eq!(found("plddt"), ["ff7d45", "ffdb13", "65cbf3", "0053d6", "65cbf3"]);
        // −3.9 and −3.5 are near the blue end, 1.9 is between white and red.
        let [lys, asp, met, other, unknown] = found("hydrophobicity").try_into().unwrap();
        assert_eq!((other.as_str(), unknown.as_str()), ("b0b0b0", "b0b0b0"));
        let byte = |color: &str, k: usize| u8::from_str_radix(&color[2 * k..2 * k + 2], 16).unwrap();
        assert!(byte(&lys, 2) > byte(&lys, 0) && byte(&asp, 2) > byte(&asp, 0) && byte(&met, 0) > byte(&met, 2));
        // Red is negative; the sulphate has −2 and the colour of the end.
        assert_eq!(found("charge")[..4], ["2166ac", "b2182b", "f7f7f7", "b2182b"]);
        assert_eq!(found("occupancy")[..2], ["fde725", "440154"]);
        assert_eq!(found("bfactor")[0], "440154");
        assert_eq!(found("bfactor")[3], "fde725");
        let cividis = [("color", "bfactor"), ("palette", "cividis"), ("color_range", "55,200")];
        assert_eq!(colors(&structure, &cividis)[..2], ["00224e", "00224e"]);
    }

    /// Three residues of a predicted model: the first is in a helix, the second in a strand.
    fn model(metric: &str, values: [&str; 3], numbers: [i32; 3]) -> String {
        let row = |i: usize| format!("C CA GLY A {} {} 10 {} 0 0", i + 1, numbers[i], 4 * i);
        let confidence = |i: usize| format!("1 A {} GLY 7 {}", i + 1, values[i]);
        let tags = |category: &str, items: &str| {
            let tags: Vec<String> = items.split(' ').map(|item| format!("_{category}.{item}")).collect();
            format!("loop_\n{}", tags.join("\n"))
        };
        let atoms = "type_symbol label_atom_id label_comp_id label_asym_id label_seq_id auth_seq_id B_iso_or_equiv \
                     Cartn_x Cartn_y Cartn_z";
        let names = "beg_auth_asym_id beg_auth_seq_id end_auth_seq_id";
        let lines = [
            "data_m\nloop_\n_ma_data.id\n1".to_owned(),
            tags("atom_site", atoms),
            [0, 1, 2].map(row).join("\n"),
            format!("_ma_qa_metric.id 7\n_ma_qa_metric.mode local\n_ma_qa_metric.type '{metric}'"),
            tags("ma_qa_metric_local", "model_id label_asym_id label_seq_id label_comp_id metric_id metric_value"),
            [0, 1, 2].map(confidence).join("\n"),
            tags("struct_conf", &format!("conf_type_id {names} pdbx_PDB_helix_class")),
            "HELX_P A 1 1 5\nSTRN A 2 2 ?\n".to_owned(),
        ];
        lines.join("\n")
    }

    #[test]
    fn the_table_of_a_predicted_model_precedes_b_factors() {
        let found = |text: &str| {
            let structure = structure(text);
            let colors = AtomColors::new(&structure, &[0, 1, 2], &coloring(&[("color", "plddt")])).unwrap();
            let all: Vec<String> = (0..3).map(|i| format!("{:06x}", colors.rgb(i))).collect();
            (all.join(" "), colors.report(&[0, 1, 2]).source.unwrap())
        };
        let classes = "ff7d45 ffdb13 0053d6".to_owned();
        let of_table = (classes.clone(), "ma_qa_metric_local");
        assert_eq!(found(&model("pLDDT", ["50", "69.9", "99"], [1, 2, 3])), of_table);
        assert_eq!(found(&model("pLDDT in [0,1]", ["0.5", "0.699", "0.99"], [1, 2, 3])), of_table);
        // Without a scale in its name, values up to 1 are not on a scale to 100.
        assert_eq!(found(&model("pLDDT", ["0.5", "0.699", "0.99"], [1, 2, 3])), of_table);
        // A ligand that the table lacks has its B-factor.
        let text =
            model("pLDDT", ["50", "69.9", "99"], [1, 2, 3]).replace("8 0 0\n", "8 0 0\nC C1 LIG B 1 1 80 40 0 0\n");
        let with_ligand = structure(&text);
        let colors = AtomColors::new(&with_ligand, &[0, 1, 2, 3], &coloring(&[("color", "plddt")])).unwrap();
        assert_eq!([0, 2, 3].map(|i| format!("{:06x}", colors.rgb(i))), ["ff7d45", "0053d6", "65cbf3"]);
        let of_b_factors = ("ff7d45 ff7d45 ff7d45".to_owned(), "b_factor");
        assert_eq!(found(&model("PAE", ["50", "69.9", "99"], [1, 2, 3])), of_b_factors);
        assert_eq!(found(&model("pLDDT", ["50", "69.9", "99"], [11, 12, 13])), of_b_factors);
    }

    #[test]
    fn secondary_structure_is_that_of_the_file() {
        let helix = structure(&model("pLDDT", ["50"; 3], [1, 2, 3]));
        let scheme = coloring(&[("color", "secondary-structure")]);
        let colors = AtomColors::new(&helix, &[0, 1, 2], &scheme).unwrap();
        let found = [0, 1, 2].map(|i| format!("{:06x}", colors.rgb(i)));
        assert_eq!(found, ["a00080", "ffc800", "b0b0b0"]);
        let legend = colors.report(&[0, 1, 2]).legend;
        assert_eq!(legend.iter().map(|e| e.label.as_str()).collect::<Vec<_>>(), ["3-10 helix", "strand", "other"]);
        let error = AtomColors::new(&structure(CIF), &ALL, &scheme).err().unwrap();
        assert!(error.why.contains("no helices and strands"), "{error}");
        // Ends in different chains.
        let text = model("pLDDT", ["50"; 3], [1, 2, 3]);
        let text =
            text.replace("_struct_conf.end_auth_seq_id", "_struct_conf.end_auth_asym_id\n_struct_conf.end_auth_seq_id");
        let text = text.replace("HELX_P A 1 1 5", "HELX_P A 1 B 1 5").replace("STRN A 2 2 ?", "STRN A 2 A 2 ?");
        let crossing = structure(&text);
        let colors = AtomColors::new(&crossing, &[0, 1, 2], &scheme).unwrap();
        assert_eq!([0, 1].map(|i| format!("{:06x}", colors.rgb(i))), ["b0b0b0", "ffc800"]);
        let warning = "ignored helices and strands whose ends are in different chains: residue 1 of chain `A` to residue 1 of chain `B`";
        assert_eq!(crossing.warnings, [warning]);
    }

    #[test]
    fn default_ranges_and_legends_describe_the_selected_atoms() {
        let structure = structure(CIF);
        let report = |pairs: &[(&str, &str)], selected: &[u32]| {
            AtomColors::new(&structure, selected, &coloring(pairs)).unwrap().report(selected)
        };
        let labels = |report: &ColorReport| report.legend.iter().map(|e| e.label.clone()).collect::<Vec<_>>();
        let b = report(&[("color", "bfactor")], &[0, 1]);
        assert_eq!(
            (b.range, b.palette, labels(&b).join(" ")),
            (Some([40.0, 55.0]), Some("viridis"), "40 43.75 47.5 51.25 55".into())
        );
        assert_eq!((b.legend[0].color.as_str(), b.legend[4].color.as_str()), ("#440154", "#fde725"));
        let charge = report(&[("color", "charge"), ("color_range", "-2,2")], &ALL);
        assert_eq!((charge.range, charge.legend[2].color.as_str()), (Some([-2.0, 2.0]), "#f7f7f7"));
        assert_eq!(labels(&report(&[("color", "entity")], &ALL)), ["1", "2", "?"]);
        assert_eq!(labels(&report(&[("color", "chain")], &[3, 1])), ["H", "L"]);
        assert_eq!(labels(&report(&[("color", "element")], &[1, 4])), ["O", "?"]);
        assert_eq!(report(&[("color", "plddt")], &ALL).legend.len(), 4);
        let one = report(&[("color", "occupancy")], &[0, 2]);
        assert_eq!((one.range, one.legend[0].color.as_str()), (Some([1.0, 1.0]), one.legend[4].color.as_str()));
    }

    #[test]
    fn plddt_may_be_written_as_a_fraction_and_must_be_plausible() {
        let with = |from: &str, to: &str| structure(&CIF.replace(from, to));
        let fractions =
            CIF.replace("40.0 1.0", "0.4 1.0").replace("55.0 0.5", "0.55 0.5").replace("90.0 1.0", "0.9 1.0");
        let fractions = structure(&fractions.replace("100.0 1.0", "1.0 1.0").replace("71.0 1.0", "0.71 1.0"));
        let plddt = [("color", "plddt")];
        assert_eq!(colors(&fractions, &plddt), colors(&structure(CIF), &plddt));
        for (text, low) in [(" 100.0 ", " 100.5 "), (" 100.0 ", " -1.0 ")] {
            let error = AtomColors::new(&with(text, low), &ALL, &coloring(&plddt)).err().unwrap();
            assert!(error.to_string().contains("the B-factors are"), "{error}");
        }
    }

    #[test]
    fn a_file_without_entities_is_named() {
        let structure = structure(&CIF.replace("struct_asym", "other"));
        let error = AtomColors::new(&structure, &ALL, &coloring(&[("color", "entity")])).err().unwrap();
        let text = error.to_string();
        assert!(
            text.contains("`entity` cannot be applied") && text.contains("expected one of none, uniform"),
            "{text}"
        );
    }

    const SAMPLE: &[u8] = include_bytes!("../../../../samples/4pti.pdb");

    fn product(pairs: &[(&str, &str)]) -> Result<Product, JobError> {
        let backend = CpuBackend::new(None).unwrap();
        let options = params::parse(pairs.iter().copied()).unwrap().options;
        let choice = Choice { backend: &backend, reason: "" };
        run(SAMPLE, &options, &JobLimits::default(), &choice, &Control::default(), &(), None)
    }

    #[test]
    fn vertices_have_the_colour_of_their_atom_and_the_same_mesh() {
        let plain = product(&[("resolution", "0.8")]).unwrap();
        let structure = read(SAMPLE, &ReadLimits::default()).unwrap();
        for scheme in ["element", "bfactor"] {
            let both = product(&[("resolution", "0.8"), ("color", scheme), ("atom_ids", "true")]).unwrap();
            let only = product(&[("resolution", "0.8"), ("color", scheme)]).unwrap();
            assert_eq!((&both.mesh.positions, &both.mesh.triangles), (&plain.mesh.positions, &plain.mesh.triangles));
            assert!(plain.mesh.colors.is_none() && only.mesh.atom_ids.is_none());
            assert_eq!(both.mesh.colors, only.mesh.colors);
            let (ids, found) = (both.mesh.atom_ids.unwrap(), both.mesh.colors.unwrap());
            let selected: Vec<u32> = (0..454).collect();
            let atoms = AtomColors::new(&structure, &selected, &coloring(&[("color", scheme)])).unwrap();
            assert!(ids.iter().zip(found.iter()).all(|(&id, color)| atoms.of(id as usize) == *color));
            let distinct: HashSet<_> = found.iter().collect();
            assert!(distinct.len() > 3, "{scheme}: {distinct:?}");
            assert_eq!(only.report.color.unwrap().scheme, scheme);
        }
        assert!(matches!(product(&[("color", "entity")]), Err(JobError::Color(_))));
    }

    #[test]
    fn palettes_and_ranges_need_numbers() {
        let refuse = |pairs: &[(&str, &str)]| params::parse(pairs.iter().copied()).unwrap_err().to_string();
        for pairs in [
            &[("palette", "cividis")][..],
            &[("color", "chain"), ("palette", "cividis")],
            &[("color", "plddt"), ("color_range", "0,100")],
            &[("color_range", "0,1"), ("color", "none")],
        ] {
            let text = refuse(pairs);
            assert!(text.contains("or a scheme with numbers: color=bfactor, occupancy, hydrophobicity"), "{text}");
        }
        for range in ["1", "1,1", "2,1", "1,2,3", "a,b", "0,inf", "nan,1", ""] {
            let text = refuse(&[("color", "bfactor"), ("color_range", range)]);
            assert!(text.contains("two numbers separated by a comma"), "{text}");
        }
        assert!(refuse(&[("color", "chains")]).contains("expected none, uniform:#RRGGBB, element"));
        assert!(refuse(&[("color", "chain"), ("color_blend", "sharp")]).contains("one of nearest, smooth"));
        assert!(refuse(&[("color_blend", "smooth")]).contains("nearest without colours"));
        assert!(refuse(&[("color", "bfactor"), ("palette", "jet")]).contains("one of viridis, cividis"));
        let key = |pairs: &[(&str, &str)]| params::canonical(&params::parse(pairs.iter().copied()).unwrap().options);
        assert_eq!(key(&[("color", "bfactor")]), key(&[("color", "bfactor"), ("palette", "viridis")]));
        assert_ne!(key(&[("color", "bfactor")]), key(&[("color", "bfactor"), ("palette", "cividis")]));
        assert_ne!(key(&[("color", "chain")]), key(&[("color", "element")]));
        assert_eq!(key(&[]), key(&[("color", "none")]));
    }
}
