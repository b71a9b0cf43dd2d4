"""Prints the atoms that gemmi reads from a structure file. tests/core/structure_real.rs compares them.

Usage: gemmi_dump.py FILE. First line: `models N N N…` (atoms of each model). Then one line per atom of the first model:
chain, residue number, insertion code, residue, atom name, altloc, atomic number, x, y, z, occupancy, B, hetero, selected.
`selected` applies the documented default selection, written here a second time; gemmi decides which HETATM residues
belong to a polymer.
"""

import sys

import gemmi

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


def main():
    structure = read(sys.argv[1])
    structure.setup_entities()
    print("models", *(model.count_atom_sites() for model in structure))
    model = structure[0]
    best = altlocs(model)
    out = []
    for chain, residue, atom in atoms(model):
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
                ]
            )
        )
    print("\n".join(out))


main()
