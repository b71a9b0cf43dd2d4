//! Tables of the colour schemes: colours and values by element and by residue name.
#![expect(clippy::unreadable_literal, reason = "colours are written as in style sheets")]

use molmesh_structure::annotations::SecondaryStructure;

use super::palette::Rgb;

/// Colour of atoms for which a scheme has no colour or value.
pub(super) const OTHER: Rgb = 0xb0b0b0;

/// Colours of chains and entities, in order of first appearance; they repeat. Distinct in hue and lightness, also for
/// people with colour blindness.
const CATEGORIES: [Rgb; 12] = [
    0x4fa59b, 0xe08e5a, 0x7f8fd0, 0xc9ad4b, 0xc56d98, 0x77a952, 0x5a9fd4, 0xb98a6a, 0x9a7cc4, 0xcf6b63, 0x5cb8b2,
    0x98a2ad,
];

/// Returns the colour of a chain or entity by its number.
pub(super) fn category(number: u32) -> Rgb {
    CATEGORIES[number as usize % CATEGORIES.len()]
}

/// Colours of hydrogen to meitnerium in Jmol (jmol.sourceforge.net/jscolors), which extend the CPK colours.
#[rustfmt::skip]
const ELEMENTS: [Rgb; 109] = [
    0xffffff, 0xd9ffff, 0xcc80ff, 0xc2ff00, 0xffb5b5, 0x909090, 0x3050f8, 0xff0d0d, 0x90e050, 0xb3e3f5,
    0xab5cf2, 0x8aff00, 0xbfa6a6, 0xf0c8a0, 0xff8000, 0xffff30, 0x1ff01f, 0x80d1e3, 0x8f40d4, 0x3dff00,
    0xe6e6e6, 0xbfc2c7, 0xa6a6ab, 0x8a99c7, 0x9c7ac7, 0xe06633, 0xf090a0, 0x50d050, 0xc88033, 0x7d80b0,
    0xc28f8f, 0x668f8f, 0xbd80e3, 0xffa100, 0xa62929, 0x5cb8d1, 0x702eb0, 0x00ff00, 0x94ffff, 0x94e0e0,
    0x73c2c9, 0x54b5b5, 0x3b9e9e, 0x248f8f, 0x0a7d8c, 0x006985, 0xc0c0c0, 0xffd98f, 0xa67573, 0x668080,
    0x9e63b5, 0xd47a00, 0x940094, 0x429eb0, 0x57178f, 0x00c900, 0x70d4ff, 0xffffc7, 0xd9ffc7, 0xc7ffc7,
    0xa3ffc7, 0x8fffc7, 0x61ffc7, 0x45ffc7, 0x30ffc7, 0x1fffc7, 0x00ff9c, 0x00e675, 0x00d452, 0x00bf38,
    0x00ab24, 0x4dc2ff, 0x4da6ff, 0x2194d6, 0x267dab, 0x266696, 0x175487, 0xd0d0e0, 0xffd123, 0xb8b8d0,
    0xa6544d, 0x575961, 0x9e4fb5, 0xab5c00, 0x754f45, 0x428296, 0x420066, 0x007d00, 0x70abfa, 0x00baff,
    0x00a1ff, 0x008fff, 0x0080ff, 0x006bff, 0x545cf2, 0x785ce3, 0x8a4fe3, 0xa136d4, 0xb31fd4, 0xb31fba,
    0xb30da6, 0xbd0d87, 0xc70066, 0xcc0059, 0xd1004f, 0xd90045, 0xe00038, 0xe6002e, 0xeb0026,
];

/// Returns the colour of an element by its atomic number.
pub(super) fn element(number: u8) -> Rgb {
    usize::from(number).checked_sub(1).and_then(|i| ELEMENTS.get(i)).copied().unwrap_or(OTHER)
}

/// Colours and hydrophobicities of amino acids. The colours are "amino" of `RasMol` (R. Sayle and E. J. Milner-White,
/// Trends Biochem. Sci. 20, 374, 1995). The values are the hydropathy index of J. Kyte and R. F. Doolittle, J. Mol.
/// Biol. 157, 105 (1982), and the hydrophobicity of W. C. Wimley and S. H. White, Nat. Struct. Biol. 3, 842 (1996): the
/// negative free energy of transfer of the whole residue from water to the interface of a POPC bilayer at pH 8,
/// kcal/mol, with charged Asp and Glu and neutral His. High values are hydrophobic in both.
const AMINO_ACIDS: [(&str, (Rgb, [f64; 2])); 20] = [
    ("ALA", (0xc8c8c8, [1.8, -0.17])),
    ("ARG", (0x145aff, [-4.5, -0.81])),
    ("ASN", (0x00dcdc, [-3.5, -0.42])),
    ("ASP", (0xe60a0a, [-3.5, -1.23])),
    ("CYS", (0xe6e600, [2.5, 0.24])),
    ("GLN", (0x00dcdc, [-3.5, -0.58])),
    ("GLU", (0xe60a0a, [-3.5, -2.02])),
    ("GLY", (0xebebeb, [-0.4, -0.01])),
    ("HIS", (0x8282d2, [-3.2, -0.17])),
    ("ILE", (0x0f820f, [4.5, 0.31])),
    ("LEU", (0x0f820f, [3.8, 0.56])),
    ("LYS", (0x145aff, [-3.9, -0.99])),
    ("MET", (0xe6e600, [1.9, 0.23])),
    ("PHE", (0x3232aa, [2.8, 1.13])),
    ("PRO", (0xdc9682, [-1.6, -0.45])),
    ("SER", (0xfa9600, [-0.8, -0.13])),
    ("THR", (0xfa9600, [-0.7, -0.14])),
    ("TRP", (0xb45ab4, [-0.9, 1.85])),
    ("TYR", (0x3232aa, [-1.3, 0.94])),
    ("VAL", (0x0f820f, [4.2, -0.07])),
];

/// Colours of nucleotides in Jmol.
const NUCLEOTIDES: [(&str, Rgb); 6] =
    [("A", 0xa0a0ff), ("C", 0xff8c4b), ("G", 0xff7070), ("I", 0x80ffff), ("T", 0xa0ffa0), ("U", 0xff8080)];

/// Returns the colour of a residue by its name.
pub(super) fn residue(name: &str) -> Rgb {
    let name = parent(name);
    find(&AMINO_ACIDS, name).map(|(color, _)| color).or_else(|| find(&NUCLEOTIDES, name)).unwrap_or(OTHER)
}

/// Returns the two hydrophobicities of a residue by its name.
pub(super) fn hydrophobicity(name: &str) -> Option<[f64; 2]> {
    find(&AMINO_ACIDS, parent(name)).map(|(_, values)| values)
}

/// Residues by formal charge at pH 7, from the pKa values of the side chains of free amino acids (CRC Handbook
/// of Chemistry and Physics) and of phosphoric acid esters. A nucleotide has the charge of its phosphate, an ion that
/// of its usual oxidation state. The ends of chains do not count.
const CHARGES: [(f64, &[&str]); 6] = [
    (1.0, &["ARG", "LYS", "HIP", "HSP", "HISH", "ORN", "MLZ", "MLY", "M3L", "NA", "K", "LI", "RB", "CS", "SOD", "POT"]),
    (2.0, &["MG", "CA", "ZN", "MN", "FE2", "CO", "NI", "CU", "CD", "SR", "BA", "CAL"]),
    (3.0, &["FE", "AL"]),
    (
        -1.0,
        &[
            "ASP", "GLU", "CYM", "KCX", "A", "C", "G", "U", "T", "I", "DA", "DC", "DG", "DT", "DU", "DI", "CL", "BR",
            "F", "IOD", "CLA",
        ],
    ),
    (-2.0, &["SEP", "TPO", "PTR", "CGU", "PO4", "SO4"]),
    (
        0.0,
        &[
            "ALA", "ASN", "CYS", "GLN", "GLY", "HIS", "ILE", "LEU", "MET", "PHE", "PRO", "SER", "THR", "TRP", "TYR",
            "VAL", "MSE", "SEC", "HID", "HIE", "HSD", "HSE", "CYX", "ASH", "GLH", "LYN", "HYP", "HOH", "WAT", "DOD",
        ],
    ),
];

/// Returns the formal charge of a residue at pH 7 by its name.
pub(super) fn charge(name: &str) -> Option<f64> {
    CHARGES.iter().find(|(_, names)| names.contains(&name)).map(|(charge, _)| *charge)
}

/// Standard residues with their protonation states and modifications.
const PARENTS: [(&str, &[&str]); 16] = [
    ("ASP", &["ASH"]),
    ("CYS", &["CYX", "CYM", "SEC", "CSO"]),
    ("GLU", &["GLH", "CGU"]),
    ("HIS", &["HID", "HIE", "HIP", "HSD", "HSE", "HSP"]),
    ("LYS", &["LYN", "MLY", "MLZ", "M3L", "KCX"]),
    ("MET", &["MSE"]),
    ("PRO", &["HYP"]),
    ("SER", &["SEP"]),
    ("THR", &["TPO"]),
    ("TYR", &["PTR"]),
    ("A", &["DA"]),
    ("C", &["DC"]),
    ("G", &["DG"]),
    ("I", &["DI"]),
    ("T", &["DT"]),
    ("U", &["DU"]),
];

/// Returns the standard residue of a variant.
fn parent(name: &str) -> &str {
    PARENTS.iter().find(|(_, variants)| variants.contains(&name)).map_or(name, |(standard, _)| standard)
}

fn find<T: Copy>(table: &[(&str, T)], name: &str) -> Option<T> {
    table.iter().find(|(known, _)| *known == name).map(|(_, value)| *value)
}

/// Label and colour of a secondary structure, by the colours "structure" of Jmol (jmol.sourceforge.net/jscolors).
pub(super) fn secondary(structure: Option<SecondaryStructure>) -> (&'static str, Rgb) {
    match structure {
        Some(SecondaryStructure::AlphaHelix) => ("alpha helix", 0xff0080),
        Some(SecondaryStructure::ThreeTenHelix) => ("3-10 helix", 0xa00080),
        Some(SecondaryStructure::PiHelix) => ("pi helix", 0x600080),
        Some(SecondaryStructure::Strand) => ("strand", 0xffc800),
        Some(SecondaryStructure::Turn) => ("turn", 0x6080ff),
        None => ("other", OTHER),
    }
}

/// Classes of the predicted local distance difference test (pLDDT, 0 to 100): upper bound, label and colour, as in the
/// `AlphaFold` Protein Structure Database (M. Varadi et al., Nucleic Acids Res. 50, D439, 2022).
pub(super) const PLDDT: [(f64, &str, Rgb); 4] = [
    (50.0, "very low (up to 50)", 0xff7d45),
    (70.0, "low (50 to 70)", 0xffdb13),
    (90.0, "high (70 to 90)", 0x65cbf3),
    (100.0, "very high (over 90)", 0x0053d6),
];
