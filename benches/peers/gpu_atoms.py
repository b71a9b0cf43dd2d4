"""Extracts the atoms of structure files for `gpu_field.py`: `gpu_atoms.py OUT_FOLDER FILE …`.

Writes NAME.npz with `positions` (N × 3, float64, Å) and `radii` (N, float32, Å) of the compared atoms (see prepare.py).
"""

import sys
from pathlib import Path

import numpy as np

import prepare
from radii import RADII

for file in map(Path, sys.argv[2:]):
    structure = prepare.heavy(file)  # rows point into it
    rows = list(structure[0].all())
    target = Path(sys.argv[1]) / f"{file.name.split('.')[0].lower()}.npz"
    radii = np.array([RADII[row.atom.element.name.upper()] for row in rows], np.float32)
    np.savez_compressed(target, positions=np.array([row.atom.pos.tolist() for row in rows]), radii=radii)
    print(f"{target}: {len(rows)} atoms")
