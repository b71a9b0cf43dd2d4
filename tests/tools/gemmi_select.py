"""Counts the atoms that gemmi selects in the first model. tests/core/structure_select.rs compares the counts.

Usage: gemmi_select.py FILE SELECTION… Prints one count per selection. `NUMBER of SELECTION` counts the atoms within
this distance (Å) of the selected ones.
"""

import sys

import gemmi


def selected(selection, model):
    return [
        atom
        for chain in selection.chains(model)
        for residue in selection.residues(chain)
        for atom in selection.atoms(residue)
    ]


def main():
    path, *selections = sys.argv[1:]
    structure = gemmi.read_structure(path)
    # Without symmetry, so that no images are found.
    structure.cell = gemmi.UnitCell()
    structure.spacegroup_hm = ""
    model = structure[0]
    for text in selections:
        distance, _, of = text.rpartition(" of ")
        atoms = selected(gemmi.Selection(of), model)
        if distance:
            search = gemmi.NeighborSearch(model, structure.cell, float(distance)).populate()
            near = {
                (mark.chain_idx, mark.residue_idx, mark.atom_idx)
                for atom in atoms
                for mark in search.find_atoms(atom.pos, "\0", radius=float(distance))
            }
            print(len(near))
        else:
            print(len(atoms))


main()
