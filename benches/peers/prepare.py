"""Writes the input files of the comparison: `prepare.py FOLDER FILE …` prints one line of JSON per file.

The files contain the atoms that molmesh meshes by default: ATOM records of the first model without hydrogens, and only
the first alternative location. They have no unit cell, so that no program treats them as periodic. The files for NAME
are

* `NAME.pdb` or `NAME.cif`, in the format of the original, for programs that read structures;
* `NAME.edt.pdb` for EDTSurf, which reads only PDB (serial numbers and chains wrap around);
* `NAME.xyz`: 32-bit coordinates for splashsurf, which does not read structures.
"""

import json
import sys
from pathlib import Path

import gemmi
import numpy as np


def read(path):
    """Reads a structure. Ignores the last columns of PDB files from before 1996, which have line numbers instead of
    elements."""
    try:
        return gemmi.read_structure(str(path))
    except RuntimeError:
        return gemmi.read_pdb(str(path), max_line_length=72)


def heavy(path):
    """Reads a structure and keeps only the compared atoms."""
    structure = read(path)
    while len(structure) > 1:
        del structure[-1]
    structure.remove_alternative_conformations()
    structure.remove_hydrogens()
    for chain in structure[0]:
        for i in reversed(range(len(chain))):
            if chain[i].het_flag != "A":
                del chain[i]
    structure.remove_empty_chains()
    structure.cell = gemmi.UnitCell()
    structure.spacegroup_hm = ""
    structure.assemblies.clear()
    structure.connections.clear()
    structure.helices.clear()
    structure.sheets.clear()
    structure.cispeps.clear()
    return structure


def pdb_lines(structure):
    """Formats ATOM records. Serials wrap around after 99,999, residue numbers after 9,999, chains after 62."""
    names = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789"
    serial = 0
    for number, chain in enumerate(structure[0]):
        for residue in chain:
            for atom in residue:
                serial += 1
                yield (
                    f"ATOM  {serial % 100000:5d} {atom.padded_name():<4s} {residue.name[:3]:>3s} {names[number % 62]}"
                    f"{residue.seqid.num % 10000:4d}    {atom.pos.x:8.3f}{atom.pos.y:8.3f}{atom.pos.z:8.3f}"
                    f"{1.0:6.2f}{20.0:6.2f}          {atom.element.name:>2s}\n"
                )
    yield "END\n"


def prepare(path, folder):
    name = path.name.removesuffix(".gz").split(".")[0].lower()
    text = ".cif" in path.name.lower()
    structure = heavy(path)
    target = folder / (name + (".cif" if text else ".pdb"))
    if text:
        structure.setup_entities()
        groups = gemmi.MmcifOutputGroups(False, atoms=True, entity=True, entity_poly=True, struct_asym=True)
        structure.make_mmcif_document(groups).write_file(str(target))
    else:
        options = gemmi.PdbWriteOptions(minimal=True, cryst1_record=False, end_record=True)
        structure.write_pdb(str(target), options)
    (folder / f"{name}.edt.pdb").write_text("".join(pdb_lines(structure)))
    points = np.array([row.atom.pos.tolist() for row in structure[0].all()], dtype="<f4")
    points.tofile(folder / f"{name}.xyz")
    return {"name": name, "file": str(target), "atoms": len(points), "elements": sorted(
        {row.atom.element.name for row in structure[0].all()})}


if __name__ == "__main__":
    for file in sys.argv[2:]:
        print(json.dumps(prepare(Path(file), Path(sys.argv[1]))), flush=True)
