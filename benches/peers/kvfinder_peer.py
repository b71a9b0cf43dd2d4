"""Pockets of KVFinder in PDB files, on the grid and with the radii of molmesh: number, volumes, areas and depths.

    pip install pykvfinder==0.9.6
    python benches/peers/kvfinder_peer.py samples/4pti.pdb …

`--own` uses the grid and the radii of pyKVFinder instead.
"""

import gzip
import logging
import sys
import time
from pathlib import Path

import numpy as np
import pyKVFinder as kv

STEP, PROBE_IN, PROBE_OUT, REMOVAL, CUTOFF = 0.6, 1.4, 4.0, 2.4, 5.0
# Radii of Bondi, as in docs/atoms.md.
RADII = {"C": 1.7, "N": 1.55, "O": 1.52, "S": 1.8, "P": 1.8, "SE": 1.9}


def polymer(path):
    """Atoms of the first model without hydrogens and ligands, in the form of pyKVFinder."""
    read = gzip.open if path.suffix == ".gz" else open
    atoms = []
    with read(path, "rt") as lines:
        for line in lines:
            if line.startswith("ENDMDL"):
                break
            element = line[76:78].strip()
            if line.startswith("ATOM") and element in RADII and line[16] in " A":
                place = [line[30:38], line[38:46], line[46:54]]
                residue = [line[22:27].strip(), line[21], line[17:20].strip(), line[12:16].strip()]
                atoms.append(residue + [text.strip() for text in place] + [str(RADII[element])])
    return np.array(atoms)


def anchored(places):
    """Corners of a box whose grid points lie at multiples of the step."""
    low = np.floor((places.min(axis=0) - 8.0) / STEP) * STEP
    high = np.ceil((places.max(axis=0) + 8.0) / STEP) * STEP
    return np.array([low] + [np.where(np.arange(3) == k, high, low) for k in range(3)])


def main():
    logging.disable(logging.WARNING)
    own = "--own" in sys.argv
    for path in (Path(name) for name in sys.argv[1:] if name != "--own"):
        atoms = polymer(path)
        if own:
            table = kv.read_vdw()
            radius = lambda a: table.get(a[2], {}).get(a[3], table["GEN"][a[3][0]])
            atoms[:, 7] = [str(radius(a)) for a in atoms]
        corners = kv.get_vertices(atoms, PROBE_OUT, STEP) if own else anchored(atoms[:, 4:7].astype(float))
        start = time.perf_counter()
        n, grid = kv.detect(atoms, corners, STEP, PROBE_IN, PROBE_OUT, REMOVAL, CUTOFF, nthreads=2)
        seconds = time.perf_counter() - start
        print(f"{path.name}: {len(atoms)} atoms, {n} pockets, {seconds:.2f} s")
        if n > 0:
            _, volumes, areas = kv.spatial(grid, STEP, nthreads=2)
            depths, deepest, _ = kv.depth(grid, STEP, nthreads=2)
            openings, _, opened = kv.openings(grid, depths, STEP, openings_cutoff=1, nthreads=2)
            for name in sorted(volumes, key=volumes.get, reverse=True):
                holes = len(opened.get(name, {}))
                print(f"  {volumes[name]:.2f} Å³, {areas[name]:.2f} Å², depth {deepest[name]:.2f} Å, {holes} openings")


main()
