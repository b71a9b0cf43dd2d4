"""Prints the positions of the atoms in an assembly that gemmi builds. tests/core/structure_assembly.rs compares them.

Usage: gemmi_assembly.py FILE ID. One line per atom without alternative locations: x, y, z. Without ID, one line per
assembly: its id and the number of its atoms, alternative locations included.
"""

import sys

import gemmi


def main():
    path, *names = sys.argv[1:]
    if ".cif" in path:
        block = next(b for b in gemmi.cif.read(path) if b.find_values("_atom_site.id"))
        structure = gemmi.make_structure_from_block(block)
    else:
        structure = gemmi.read_pdb(path)
    structure.setup_entities()
    if not names:
        for assembly in structure.assemblies:
            model = gemmi.make_assembly(assembly, structure[0], gemmi.HowToNameCopiedChain.Short)
            print(assembly.name, sum(chain.count_atom_sites() for chain in model))
        return
    assembly = next(a for a in structure.assemblies if a.name == names[0])
    model = gemmi.make_assembly(assembly, structure[0], gemmi.HowToNameCopiedChain.Short)
    for chain in model:
        for residue in chain:
            for atom in residue:
                if not atom.has_altloc():
                    print(f"{atom.pos.x:.6f} {atom.pos.y:.6f} {atom.pos.z:.6f}")


main()
