"""Extracts the atoms of structure files: `atom_arrays.py OUT_FOLDER FILE …` prints one line of JSON per file.

Writes NAME.npz for `gpu_field.py` and `package_peer.py`.
"""

import json
import sys
from pathlib import Path

import numpy as np

import prepare
from radii import RADII


def arrays(path):
    """Returns `positions` (N × 3, float64, Å), `radii` (N, float32, Å) and `elements` of the compared atoms of a
    structure file (see prepare.py)."""
    structure = prepare.heavy(path)  # rows point into it
    rows = list(structure[0].all())
    elements = [row.atom.element.name.upper() for row in rows]
    return {
        "positions": np.array([row.atom.pos.tolist() for row in rows]),
        "radii": np.array([RADII[element] for element in elements], np.float32),
        "elements": np.array(elements),
    }


if __name__ == "__main__":
    for file in map(Path, sys.argv[2:]):
        atoms, target = arrays(file), Path(sys.argv[1]) / f"{file.name.split('.')[0].lower()}.npz"
        np.savez_compressed(target, **atoms)
        print(json.dumps({"file": str(target), "atoms": len(atoms["radii"])}))
