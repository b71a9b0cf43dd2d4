//! Atomic numbers of element symbols, and guesses of the element if a file does not contain it.
//!
//! An atom name such as `CA` is a carbon or a calcium. PDB files right-align the symbol in the first two columns of the
//! name, so ` CA ` is a carbon and `CA  ` a calcium. The residue takes precedence over the alignment, because files
//! with misaligned names are common and calcium inside an alanine is not.

use super::residue;

/// Symbols by atomic number, from 1.
pub const SYMBOLS: [&str; 118] = [
    "H", "He", "Li", "Be", "B", "C", "N", "O", "F", "Ne", "Na", "Mg", "Al", "Si", "P", "S", "Cl", "Ar", "K", "Ca",
    "Sc", "Ti", "V", "Cr", "Mn", "Fe", "Co", "Ni", "Cu", "Zn", "Ga", "Ge", "As", "Se", "Br", "Kr", "Rb", "Sr", "Y",
    "Zr", "Nb", "Mo", "Tc", "Ru", "Rh", "Pd", "Ag", "Cd", "In", "Sn", "Sb", "Te", "I", "Xe", "Cs", "Ba", "La", "Ce",
    "Pr", "Nd", "Pm", "Sm", "Eu", "Gd", "Tb", "Dy", "Ho", "Er", "Tm", "Yb", "Lu", "Hf", "Ta", "W", "Re", "Os", "Ir",
    "Pt", "Au", "Hg", "Tl", "Pb", "Bi", "Po", "At", "Rn", "Fr", "Ra", "Ac", "Th", "Pa", "U", "Np", "Pu", "Am", "Cm",
    "Bk", "Cf", "Es", "Fm", "Md", "No", "Lr", "Rf", "Db", "Sg", "Bh", "Hs", "Mt", "Ds", "Rg", "Cn", "Nh", "Fl", "Mc",
    "Lv", "Ts", "Og",
];

/// Atomic numbers by letters: first letter (A is 1) times 32 plus the second (none is 0).
const BY_LETTERS: [u8; 1024] = {
    let mut table = [0; 1024];
    let mut z = 0_u8;
    while (z as usize) < SYMBOLS.len() {
        let s = SYMBOLS[z as usize].as_bytes();
        let second = if s.len() == 2 { s[1] & 31 } else { 0 };
        table[(s[0] & 31) as usize * 32 + second as usize] = z + 1;
        z += 1;
    }
    // Deuterium and tritium are hydrogen.
    table[(b'D' & 31) as usize * 32] = 1;
    table[(b'T' & 31) as usize * 32] = 1;
    table
};

/// Returns the atomic number of a symbol in any case, or 0 if there is no such element. `D` is 1. A charge after the
/// symbol (`FE3+`, `O1-`) is ignored.
#[inline]
#[must_use]
pub fn atomic_number(symbol: &[u8]) -> u8 {
    match *symbol {
        [a] if a.is_ascii_alphabetic() => BY_LETTERS[usize::from(a & 31) * 32],
        [a, b] if a.is_ascii_alphabetic() && b.is_ascii_alphabetic() => {
            BY_LETTERS[usize::from(a & 31) * 32 + usize::from(b & 31)]
        }
        [ref bare @ .., b'0'..=b'9' | b'+' | b'-'] if !bare.is_empty() && symbol.len() <= 5 => atomic_number(bare),
        _ => 0,
    }
}

/// Returns the symbol of an element by atomic number; `?` if there is none.
#[must_use]
pub fn symbol(z: u8) -> &'static str {
    z.checked_sub(1).and_then(|i| SYMBOLS.get(usize::from(i)).copied()).unwrap_or("?")
}

/// Bit of an element that was guessed from the names of atom and residue, while a file is read.
pub(super) const GUESSED: u8 = 0x80;

/// Returns the atomic number that a file states, 0 for symbols of dummy atoms such as `X`, and `None` for other text.
/// Reads the atom types of `AutoDock` (PDBQT) that are not symbols.
#[inline]
pub(super) fn stated(symbol: &[u8]) -> Option<u8> {
    match atomic_number(symbol) {
        0 => stated_type(symbol),
        z => Some(z),
    }
}

#[cold]
fn stated_type(symbol: &[u8]) -> Option<u8> {
    match &*symbol.to_ascii_uppercase() {
        b"A" | b"CG" | b"CG0" | b"CG1" | b"CG2" | b"CG3" => Some(6),
        b"HD" => Some(1),
        b"OA" => Some(8),
        b"SA" => Some(16),
        b"X" | b"DU" | b"G" | b"G0" | b"G1" | b"G2" | b"G3" | b"J" | b"Q" | b"Z" | b"LP" | b"EP" | b"TZ" => Some(0),
        _ => None,
    }
}

/// Returns the atomic number of an atom type of PDBQT, 0 for pseudo atoms. Some types are symbols of other elements.
pub(super) fn pdbqt_type(name: &[u8]) -> u8 {
    match name {
        b"NA" | b"NS" => 7,
        b"HS" => 1,
        b"OS" => 8,
        b"GA" | b"W" => 0,
        _ => stated(name).unwrap_or(0),
    }
}

/// Names of Martini beads, which identify a coarse-grained residue.
const BEADS: &[&str] = &[
    "BB", "BB1", "BB2", "BB3", "BAS", "SC1", "SC2", "SC3", "SC4", "SC5", "SC6", "NC3", "GL0", "GL1", "GL2", "GL3",
    "GL4", "AM1", "AM2", "ROH", "W",
];

/// Returns true for the names of beads that identify a coarse-grained residue (Martini).
pub(super) fn is_bead(name: &str) -> bool {
    BEADS.contains(&name)
}

/// Returns true for metals and halogens, by atomic number.
pub(super) const fn forms_ions(z: u8) -> bool {
    // Neither hydrogen, the noble gases, nor B, C, N, O, Si, P, S, Ge, As, Se, Sb, Te.
    !matches!(z, 0..=2 | 5..=8 | 10 | 14..=16 | 18 | 32..=34 | 36 | 51 | 52 | 54 | 86 | 118..)
}

/// Returns true for metals, by atomic number.
pub(super) const fn is_metal(z: u8) -> bool {
    forms_ions(z) && !matches!(z, 9 | 17 | 35 | 53 | 85)
}

/// Two-letter elements that an atom name alone identifies, as in `CL1`, `FE`, `BR12`. Their letters cannot be read as
/// carbon, nitrogen, oxygen, sulphur, phosphorus or hydrogen followed by a remoteness letter.
const SURE: &[&[u8; 2]] = &[
    b"CL", b"BR", b"FE", b"ZN", b"MG", b"MN", b"CU", b"NI", b"NA", b"LI", b"AL", b"SI", b"SE", b"AS", b"RU", b"RH",
    b"PT", b"AU", b"AG", b"IR", b"MO", b"SR", b"RB", b"TI", b"ZR", b"GA", b"XE", b"KR", b"YB", b"GD", b"LA", b"TL",
];

/// Two-letter elements that are unambiguous outside polymers even if their name is aligned as that of a one-letter
/// element.
const SURE_ANYWHERE: &[&[u8; 2]] = &[b"FE", b"BR", b"ZN", b"MG", b"MN"];

/// An atom name as the file writes it.
#[derive(Debug, Clone, Copy)]
pub(super) struct AtomName<'a> {
    /// Without padding.
    pub(super) text: &'a [u8],
    /// The four name columns of a PDB file, if their alignment can be trusted.
    pub(super) columns: Option<[u8; 4]>,
}

/// Guesses the atomic number from the names of atom and residue, and marks it as [`GUESSED`]. Returns 0 if they suggest
/// none.
pub(super) fn guess(name: AtomName<'_>, residue: &str) -> u8 {
    match guessed(name, residue) {
        0 => 0,
        z => z | GUESSED,
    }
}

fn guessed(name: AtomName<'_>, residue: &str) -> u8 {
    let upper = name.text.to_ascii_uppercase();
    let letters_at = upper.iter().position(u8::is_ascii_alphabetic).unwrap_or(upper.len());
    let rest = &upper[letters_at..];
    let n_letters = rest.iter().take_while(|b| b.is_ascii_alphabetic()).count();
    let letters = &rest[..n_letters];
    let Some(&first) = letters.first() else { return 0 };
    let single = single(letters, first);
    if let Some(ion) = single_ion(letters, residue) {
        return ion;
    }
    if residue::is_polymer(residue) || residue::is_water(residue) {
        return match first {
            b'S' if letters.starts_with(b"SE") && matches!(residue, "MSE" | "SEC") => 34,
            // Side chains of coarse-grained models.
            b'S' if letters.starts_with(b"SC") => 0,
            b'H' | b'D' | b'C' | b'N' | b'O' | b'P' | b'S' => single,
            _ => 0,
        };
    }
    // A leading digit numbers a hydrogen or a carbon, never a metal.
    let two = if letters_at == 0 { letters.get(..2) } else { None };
    match (two, name.columns) {
        (Some(two), Some([b' ', ..])) if n_letters == 2 && SURE_ANYWHERE.iter().any(|s| s.as_slice() == two) => {
            atomic_number(two)
        }
        // ` CL1`: a symbol of one letter, by its alignment. `1HB `: a leading number.
        (_, Some([b' ', ..])) | (None, _) => single,
        // `HG11`, `CA12`, `NB1A`: all columns are used, so there is no alignment. Hydrogen and carbon are more likely.
        (Some(two), Some([_, _, _, last])) if last != b' ' => sure(two, n_letters).unwrap_or(single),
        (Some(two), Some(_)) => aligned_left(two, residue).unwrap_or(single),
        (Some(two), None) => sure(two, n_letters).unwrap_or(single),
    }
}

/// Returns the element of a symbol of one letter. Rare elements need a name without other letters.
fn single(letters: &[u8], first: u8) -> u8 {
    let is_rare = matches!(first, b'B' | b'K' | b'T' | b'U' | b'V' | b'W' | b'Y');
    if is_rare && letters.len() > 1 { 0 } else { atomic_number(&[first]) }
}

/// Returns the element of a monatomic residue named like its atom: `CA` in `CA`, `CL` in `CL-`, `SOD` in `SOD`.
fn single_ion(letters: &[u8], residue: &str) -> Option<u8> {
    let bare: Vec<u8> = residue.bytes().filter(u8::is_ascii_alphabetic).map(|b| b.to_ascii_uppercase()).collect();
    if bare != letters {
        return None;
    }
    residue::charmm_ion(residue).or_else(|| (letters.len() == 2).then(|| atomic_number(letters)).filter(|&z| z != 0))
}

fn sure(two: &[u8], n_letters: usize) -> Option<u8> {
    (n_letters == 2 && SURE.iter().any(|s| s.as_slice() == two)).then(|| atomic_number(two))
}

/// Returns the element of a two-letter symbol in the first two columns, where the format puts it.
fn aligned_left(two: &[u8], residue: &str) -> Option<u8> {
    // Left-justified hydrogens (`HO1 `, `HE  `) are more common than helium, holmium, hafnium and hassium, and
    // deuterium is more common than dysprosium. These elements are accepted only if the residue names them.
    let rare = matches!(two, b"HE" | b"HO" | b"HF" | b"HS" | b"DY" | b"DB" | b"DS");
    let named = residue.as_bytes().get(..2).is_some_and(|r| r.eq_ignore_ascii_case(two));
    (!rare || named).then(|| atomic_number(two)).filter(|&z| z != 0)
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    fn pdb(columns: &[u8; 4], residue: &str) -> &'static str {
        symbol(guess(AtomName { text: columns.trim_ascii(), columns: Some(*columns) }, residue) & !GUESSED)
    }

    fn cif(name: &str, residue: &str) -> &'static str {
        symbol(guess(AtomName { text: name.as_bytes(), columns: None }, residue) & !GUESSED)
    }

    #[test]
    fn every_symbol_is_found() {
        for (i, s) in SYMBOLS.iter().enumerate() {
            for text in [(*s).to_owned(), s.to_uppercase(), s.to_lowercase(), format!("{s}2+")] {
                assert_eq!(usize::from(atomic_number(text.as_bytes())), i + 1, "{text}");
            }
        }
        assert_eq!(atomic_number(b"D"), 1);
        for bad in [&b""[..], b"X", b"Xx", b"1", b"+", b"C@", b"ABC", b"C1+++++", b"\xe9"] {
            assert_eq!(atomic_number(bad), 0, "{bad:?}");
        }
    }

    #[test]
    fn calcium_is_told_from_carbon_by_alignment_and_residue() {
        assert_eq!(pdb(b" CA ", "ALA"), "C");
        assert_eq!(pdb(b"CA  ", "ALA"), "C");
        assert_eq!(pdb(b"CA  ", "CA"), "Ca");
        assert_eq!(pdb(b" CA ", "CA"), "Ca");
        assert_eq!(pdb(b"CA  ", "XYZ"), "Ca");
        assert_eq!(pdb(b" CA ", "XYZ"), "C");
        assert_eq!(pdb(b"CAL ", "CAL"), "Ca");
        assert_eq!(cif("CA", "CA"), "Ca");
        assert_eq!(cif("CA", "GLY"), "C");
        assert_eq!(cif("CA", "XYZ"), "C");
    }

    #[test]
    fn hydrogens_are_told_from_mercury() {
        assert_eq!(pdb(b"HG11", "VAL"), "H");
        assert_eq!(pdb(b" HG ", "SER"), "H");
        assert_eq!(pdb(b"HG  ", "SER"), "H");
        assert_eq!(pdb(b"HG11", "XYZ"), "H");
        assert_eq!(pdb(b"HG  ", "HG"), "Hg");
        assert_eq!(pdb(b"HG  ", "MMC"), "Hg");
        assert_eq!(pdb(b"HO1 ", "XYZ"), "H");
        assert_eq!(pdb(b"HO  ", "HO3"), "Ho");
        assert_eq!(pdb(b"1HB ", "ALA"), "H");
        assert_eq!(pdb(b"2HG1", "XYZ"), "H");
        assert_eq!(pdb(b" D1 ", "DOD"), "H");
        assert_eq!(pdb(b"DG11", "VAL"), "H");
    }

    #[test]
    fn ions_metals_and_halogens() {
        assert_eq!(pdb(b"SOD ", "SOD"), "Na");
        assert_eq!(pdb(b" CLA", "CLA"), "Cl");
        assert_eq!(pdb(b"POT ", "POT"), "K");
        assert_eq!(pdb(b"Na+ ", "Na+"), "Na");
        assert_eq!(pdb(b"CL  ", "CL-"), "Cl");
        assert_eq!(pdb(b"ZN  ", "ZN2"), "Zn");
        assert_eq!(pdb(b"FE  ", "HEM"), "Fe");
        assert_eq!(pdb(b" NA ", "HEM"), "N");
        assert_eq!(pdb(b"CL12", "LIG"), "Cl");
        assert_eq!(pdb(b"CAA1", "LIG"), "C");
        assert_eq!(pdb(b"C10A", "LIG"), "C");
        assert_eq!(pdb(b"SE  ", "MSE"), "Se");
        assert_eq!(pdb(b" P  ", "DA"), "P");
        assert_eq!(pdb(b" O5*", "C"), "O");
        assert_eq!(pdb(b" OW ", "SOL"), "O");
        assert_eq!(pdb(b"HW1 ", "SOL"), "H");
        assert_eq!(pdb(b" MW ", "SOL"), "?");
        assert_eq!(pdb(b" 1  ", "XYZ"), "?");
        assert_eq!(cif("BR1", "LIG"), "Br");
        assert_eq!(cif("O5'", "DA"), "O");
        assert_eq!(cif("C1'", "LIG"), "C");
        assert_eq!(cif("UNK", "LIG"), "?");
        assert_eq!(cif("U1", "LIG"), "U");
        for (name, element) in [(b" FE ", "Fe"), (b" BR1", "Br"), (b" ZN ", "Zn"), (b" MG ", "Mg"), (b" MN ", "Mn")] {
            assert_eq!((pdb(name, "LIG"), pdb(name, "ALA")), (element, pdb(&[b' ', name[1], b' ', b' '], "ALA")));
        }
        assert_eq!(pdb(b" CU ", "LIG"), "C");
    }

    #[test]
    fn beads_are_no_atoms() {
        for bead in ["BB", "SC1", "SC4", "BAS", "GN", "BCE"] {
            assert_eq!(cif(bead, "LEU"), "?", "{bead}");
        }
        assert_eq!(["SG", "S", "CA", "N", "OXT", "HB1"].map(|name| cif(name, "CYS")), ["S", "S", "C", "N", "O", "H"]);
        assert!(is_bead("GL1") && !is_bead("CA") && !is_bead("C1A"));
    }

    #[test]
    fn stated_symbols_are_not_guessed() {
        for (symbol, z) in [(&b"X"[..], 0), (b"DU", 0), (b"G0", 0), (b"Cl", 17), (b"A", 6), (b"OA", 8), (b"NA", 11)] {
            assert_eq!(stated(symbol), Some(z), "{symbol:?}");
        }
        assert_eq!([&b"CT1"[..], b"PROA", b""].map(stated), [None; 3]);
        for (name, z) in
            [(&b"NA"[..], 7), (b"Na", 11), (b"HS", 1), (b"OS", 8), (b"Ca", 20), (b"W", 0), (b"?", 0), (b"C", 6)]
        {
            assert_eq!(pdbqt_type(name), z, "{name:?}");
        }
    }
}
