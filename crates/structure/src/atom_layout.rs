//! Columns of the mmCIF category `atom_site`.

use std::collections::HashMap;

/// Marks a column that does not exist.
pub(super) const NONE: usize = usize::MAX;

/// Column index of each item in a row; [`NONE`] for missing items.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    /// Number of items in a row.
    pub(super) width: usize,
    pub(super) group: usize,
    pub(super) element: usize,
    pub(super) name: [usize; 2],
    pub(super) residue: [usize; 2],
    pub(super) chain: [usize; 2],
    pub(super) number: [usize; 2],
    pub(super) sequence_number: usize,
    pub(super) insertion_code: usize,
    pub(super) altloc: usize,
    pub(super) position: [usize; 3],
    pub(super) occupancy: usize,
    pub(super) b_factor: usize,
    pub(super) model: [usize; 2],
    pub(super) label_chain: usize,
    pub(super) entity: usize,
}

/// Items of the coordinates.
pub(super) const POSITION: [&str; 3] = ["Cartn_x", "Cartn_y", "Cartn_z"];

impl Layout {
    /// Returns the layout of rows of `items`, in any letter case, or the index of an item that occurs twice.
    pub(super) fn of<'n>(items: impl ExactSizeIterator<Item = &'n [u8]>) -> Result<Self, usize> {
        let width = items.len();
        let mut found = HashMap::with_capacity(width);
        for (i, item) in items.enumerate() {
            if found.insert(item.to_ascii_lowercase(), i).is_some() {
                return Err(i);
            }
        }
        let column = |item: &str| found.get(item.to_ascii_lowercase().as_bytes()).copied().unwrap_or(NONE);
        // The author's item comes first, the dictionary's item is the fallback.
        let pair = |auth: &str, label: &str| match (column(auth), column(label)) {
            (NONE, label) => [label, NONE],
            (auth, label) => [auth, label],
        };
        Ok(Self {
            width,
            group: column("group_PDB"),
            element: column("type_symbol"),
            name: pair("auth_atom_id", "label_atom_id"),
            residue: pair("auth_comp_id", "label_comp_id"),
            chain: pair("auth_asym_id", "label_asym_id"),
            number: pair("auth_seq_id", "label_seq_id"),
            sequence_number: column("label_seq_id"),
            insertion_code: column("pdbx_PDB_ins_code"),
            altloc: column("label_alt_id"),
            position: POSITION.map(column),
            occupancy: column("occupancy"),
            b_factor: column("B_iso_or_equiv"),
            // Files of integrative models number their models in a column of their own.
            model: pair("ihm_model_id", "pdbx_PDB_model_num"),
            label_chain: column("label_asym_id"),
            entity: column("label_entity_id"),
        })
    }

    /// Describes missing coordinate items, for the error message of a file without atoms. Returns `None` if all exist.
    pub(super) fn missing(&self) -> Option<String> {
        let missing: Vec<&str> =
            POSITION.iter().zip(self.position).filter(|(_, column)| *column == NONE).map(|(item, _)| *item).collect();
        (!missing.is_empty()).then(|| format!("atom_site without {}", missing.join(", ")))
    }

    /// Returns the text columns. The second of a pair is the fallback for rows where the first has no value.
    pub(super) fn texts(&self) -> [[usize; 2]; 9] {
        let alone = |column| [column, NONE];
        let (names, others) = ([self.name, self.residue, self.chain], [self.group, self.element]);
        let [name, residue, chain] = names;
        let [group, element] = others.map(alone);
        let others = [self.insertion_code, self.altloc, self.label_chain, self.entity];
        let [code, altloc, label, entity] = others.map(alone);
        [group, element, name, residue, chain, code, altloc, label, entity]
    }

    /// Returns the number columns, in the same form.
    pub(super) fn numbers(&self) -> [[usize; 2]; 8] {
        let [x, y, z] = self.position;
        let others = [x, y, z, self.occupancy, self.b_factor, self.sequence_number];
        let [x, y, z, occupancy, b_factor, sequence] = others.map(|column| [column, NONE]);
        [self.number, x, y, z, occupancy, b_factor, self.model, sequence]
    }

    /// Removes the items that other categories replace: `label_entity_id`, and `label_seq_id` except as a fallback for
    /// the author's number.
    pub(super) fn with_known_entities(self) -> Self {
        Self { sequence_number: NONE, entity: NONE, ..self }
    }
}
