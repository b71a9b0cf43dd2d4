"""Prints the atoms that gemmi reads from a structure file. tests/core/structure_real.rs compares them.

Usage: gemmi_dump.py FILE. First line: `models N N N…` (atoms of each model). Then one line per atom of the first model:
chain, residue number, insertion code, residue, atom name, altloc, atomic number, x, y, z, occupancy, B, hetero,
selected, kind. `selected` applies the documented default selection, written here a second time; gemmi decides which
HETATM residues belong to a polymer. `kind` is the kind of the residue: gemmi decides by entities, types of polymers and
its table of residues, and biotite which names are those of saccharides, amino acids and nucleotides. Neither knows
cofactors, which are ligands here.
"""

import sys

import gemmi
from biotite.structure import info

WATER = {"HOH", "WAT", "H2O", "DOD", "TIP", "TIP3", "SOL"}
IONS = {"SOD", "CLA", "POT", "NA", "CL", "K", "MG", "ZN"}


def read(path):
    if ".cif" in path:
        return gemmi.make_structure_from_block(first_block(gemmi.cif.read(path)))
    return gemmi.read_pdb(path)


def first_block(doc):
    return next(b for b in doc if b.find_values("_atom_site.id"))


def atoms(model):
    for chain in model:
        for residue in chain:
            for atom in residue:
                yield chain, residue, atom


def kinds_of_atoms(model):
    """Yields the kind of each atom, in the order of `atoms`."""
    for chain in model:
        polymer = chain.get_polymer().check_polymer_type()
        for residue in chain:
            is_polymer = residue.entity_type == gemmi.EntityType.Polymer or residue.het_flag != "H"
            yield from [kind(residue, polymer if is_polymer else None)] * len(residue)


def altlocs(model):
    """Returns the alternative location per chain and residue number: highest mean occupancy, then lowest letter."""
    groups = {}
    for chain, residue, atom in atoms(model):
        if atom.has_altloc():
            group = groups.setdefault((chain.name, str(residue.seqid)), {})
            group.setdefault(atom.altloc, []).append(atom.occ)
    best = {}
    for key, letters in groups.items():
        best[key] = min(letters, key=lambda a: (-round(sum(letters[a]) / len(letters[a]), 4), a))
    return best


AMINO_ACIDS, NUCLEOTIDES, SACCHARIDES = (
    set(names()) for names in (info.amino_acid_names, info.nucleotide_names, info.carbohydrate_names)
)
POLYMERS = {
    gemmi.PolymerType.PeptideL: "protein",
    gemmi.PolymerType.PeptideD: "protein",
    gemmi.PolymerType.Dna: "nucleic",
    gemmi.PolymerType.Rna: "nucleic",
    gemmi.PolymerType.DnaRnaHybrid: "nucleic",
}
HALOGENS = {"F", "Cl", "Br", "I"}


def kind(residue, polymer):
    """Returns the kind of a residue; `polymer` is the type of its polymer, None for other residues."""
    table = gemmi.find_tabulated_residue(residue.name)
    elements = {atom.element for atom in residue}
    if residue.name in WATER or table.is_water():
        return "water"
    if all(element.is_metal or element.name in HALOGENS for element in elements):
        return "ion"
    if polymer is None:
        sugar = residue.entity_type == gemmi.EntityType.Branched or residue.name in SACCHARIDES
        return "glycan" if sugar else "ligand"
    if residue.name in AMINO_ACIDS or table.is_amino_acid():
        return "protein"
    if residue.name in NUCLEOTIDES or table.is_nucleic_acid():
        return "nucleic"
    return POLYMERS.get(polymer, "polymer")


def main():
    structure = read(sys.argv[1])
    structure.setup_entities()
    print("models", *(model.count_atom_sites() for model in structure))
    model = structure[0]
    best = altlocs(model)
    out = []
    for (chain, residue, atom), of_residue in zip(atoms(model), kinds_of_atoms(model), strict=True):
        hetero = residue.het_flag == "H"
        key = (chain.name, str(residue.seqid))
        polymer = residue.entity_type == gemmi.EntityType.Polymer if hetero else residue.name not in IONS
        selected = (
            polymer
            and not atom.is_hydrogen()
            and residue.name not in WATER
            and (not atom.has_altloc() or atom.altloc == best[key])
        )
        out.append(
            "\t".join(
                [
                    chain.name,
                    str(residue.seqid.num or 0),
                    residue.seqid.icode.strip(),
                    residue.name,
                    atom.name,
                    atom.altloc.strip("\0"),
                    str(atom.element.atomic_number),
                    f"{atom.pos.x:.5f}",
                    f"{atom.pos.y:.5f}",
                    f"{atom.pos.z:.5f}",
                    f"{atom.occ:.4f}",
                    f"{atom.b_iso:.4f}",
                    "1" if hetero else "0",
                    "1" if selected else "0",
                    of_residue,
                ]
            )
        )
    print("\n".join(out))


main()
