//! Van der Waals radii.

/// Names the table, for reports.
pub const TABLE: &str = "Bondi 1964, completed by Mantina et al. 2009; 2.0 Å elsewhere";

/// Van der Waals radius of an element by atomic number (0: unknown), Å.
#[must_use]
pub fn vdw_radius(atomic_number: u8) -> f32 {
    match atomic_number {
        1 => 1.10,
        6 => 1.70,
        7 => 1.55,
        8 => 1.52,
        16 => 1.80,
        _ => 2.0,
    }
}
