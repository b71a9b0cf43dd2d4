//! Van der Waals radii of all elements.
//!
//! A. Bondi, *van der Waals Volumes and Radii*, J. Phys. Chem. 68, 441 (1964), as completed for the main groups by M.
//! Mantina, A. C. Chamberlin, R. Valero, C. J. Cramer, D. G. Truhlar, *Consistent van der Waals Radii for the Whole
//! Main Group*, J. Phys. Chem. A 113, 5806 (2009), table 12: Bondi's values where these authors keep them (hydrogen is
//! 1.10 Å there, after Rowland and Taylor 1996), theirs for the main-group elements that Bondi lacks. Transition metals
//! that Bondi lists keep his values. All other elements have the radius [`FALLBACK`]. There are no united atoms: radii
//! do not account for hydrogens that a file leaves out.

use super::element::SYMBOLS;

/// Name of the table, for reports.
pub const TABLE: &str = "Bondi 1964, completed by Mantina et al. 2009; 2.0 Å elsewhere";

/// Name of radii from the file, for reports.
pub const OF_FILE: &str = "radii of the file";

/// Radius of elements without a value in either source, and of unknown elements, Å.
pub const FALLBACK: f32 = 2.0;

/// Short name of [`FALLBACK`] for the table.
const FB: f32 = FALLBACK;

/// Radii by atomic number, 0 for unknown elements. The main groups are those of Mantina et al. 2009, table 12, and the
/// other elements (28 to 30, 46 to 48, 78 to 80, 92) those of Bondi 1964.
const RADII: [f32; SYMBOLS.len() + 1] = [
    FB, // unknown
    1.10, 1.40, // H and He
    1.81, 1.53, 1.92, 1.70, 1.55, 1.52, 1.47, 1.54, // Li to Ne
    2.27, 1.73, 1.84, 2.10, 1.80, 1.80, 1.75, 1.88, // Na to Ar
    2.75, 2.31, FB, FB, FB, FB, FB, FB, FB, 1.63, 1.40, 1.39, 1.87, 2.11, 1.85, 1.90, 1.83, 2.02, // K to Kr
    3.03, 2.49, FB, FB, FB, FB, FB, FB, FB, 1.63, 1.72, 1.58, 1.93, 2.17, 2.06, 2.06, 1.98, 2.16, // Rb to Xe
    3.43, 2.68, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, 1.72, 1.66, 1.55,
    1.96, 2.02, 2.07, 1.97, 2.02, 2.20, // Cs to Rn
    3.48, 2.83, FB, FB, FB, 1.86, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB, FB,
    FB, FB, FB, FB, FB, // Fr to Og
];

/// Returns the van der Waals radius (Å) of an element by atomic number (0: unknown).
#[must_use]
pub fn vdw_radius(atomic_number: u8) -> f32 {
    RADII.get(usize::from(atomic_number)).copied().unwrap_or(FALLBACK)
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::super::element::atomic_number;
    use super::*;

    #[test]
    fn every_element_has_a_plausible_radius() {
        for z in 0..=u8::MAX {
            assert!((1.0..=3.5).contains(&vdw_radius(z)), "{z}");
        }
    }

    #[test]
    fn values_of_the_two_papers() {
        let cases = [
            ("H", 1.10),
            ("C", 1.70),
            ("N", 1.55),
            ("O", 1.52),
            ("F", 1.47),
            ("Si", 2.10),
            ("P", 1.80),
            ("S", 1.80),
            ("Cl", 1.75),
            ("Se", 1.90),
            ("Br", 1.83),
            ("I", 1.98),
            ("Na", 2.27),
            ("Mg", 1.73),
            ("K", 2.75),
            ("Ca", 2.31),
            ("Zn", 1.39),
            ("Cu", 1.40),
            ("Ni", 1.63),
            ("Hg", 1.55),
            ("U", 1.86),
            ("Fe", FALLBACK),
            ("Mn", FALLBACK),
            ("Og", FALLBACK),
        ];
        for (symbol, radius) in cases {
            assert_eq!(vdw_radius(atomic_number(symbol.as_bytes())).to_bits(), f32::to_bits(radius), "{symbol}");
        }
    }
}
