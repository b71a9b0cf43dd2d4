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

/// Radius of elements without a value in either source, and of unknown elements, Å.
pub const FALLBACK: f32 = 2.0;

/// Hydrogen to krypton without the transition metals, then by period: Mantina et al. 2009, table 12.
const MAIN_GROUP: [(u8, f32); 44] = [
    (1, 1.10),
    (2, 1.40),
    (3, 1.81),
    (4, 1.53),
    (5, 1.92),
    (6, 1.70),
    (7, 1.55),
    (8, 1.52),
    (9, 1.47),
    (10, 1.54),
    (11, 2.27),
    (12, 1.73),
    (13, 1.84),
    (14, 2.10),
    (15, 1.80),
    (16, 1.80),
    (17, 1.75),
    (18, 1.88),
    (19, 2.75),
    (20, 2.31),
    (31, 1.87),
    (32, 2.11),
    (33, 1.85),
    (34, 1.90),
    (35, 1.83),
    (36, 2.02),
    (37, 3.03),
    (38, 2.49),
    (49, 1.93),
    (50, 2.17),
    (51, 2.06),
    (52, 2.06),
    (53, 1.98),
    (54, 2.16),
    (55, 3.43),
    (56, 2.68),
    (81, 1.96),
    (82, 2.02),
    (83, 2.07),
    (84, 1.97),
    (85, 2.02),
    (86, 2.20),
    (87, 3.48),
    (88, 2.83),
];

/// Bondi 1964: metals outside the main groups.
const BONDI_METALS: [(u8, f32); 10] = [
    (28, 1.63),
    (29, 1.40),
    (30, 1.39),
    (46, 1.63),
    (47, 1.72),
    (48, 1.58),
    (78, 1.72),
    (79, 1.66),
    (80, 1.55),
    (92, 1.86),
];

const RADII: [f32; SYMBOLS.len() + 1] = {
    let mut radii = [FALLBACK; SYMBOLS.len() + 1];
    let mut i = 0;
    while i < MAIN_GROUP.len() {
        radii[MAIN_GROUP[i].0 as usize] = MAIN_GROUP[i].1;
        i += 1;
    }
    i = 0;
    while i < BONDI_METALS.len() {
        radii[BONDI_METALS[i].0 as usize] = BONDI_METALS[i].1;
        i += 1;
    }
    radii
};

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
        let mut given: Vec<u8> = MAIN_GROUP.iter().chain(&BONDI_METALS).map(|&(z, _)| z).collect();
        given.sort_unstable();
        given.dedup();
        assert_eq!(given.len(), MAIN_GROUP.len() + BONDI_METALS.len(), "no element twice");
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
