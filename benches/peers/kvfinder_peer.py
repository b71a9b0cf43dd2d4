"""Pockets of KVFinder in PDB files, on the grid and with the radii of molmesh: number, volumes, areas and depths.

    pip install gemmi==0.7.5 numpy==2.4.6 pykvfinder==0.9.6
    python benches/peers/kvfinder_peer.py samples/4pti.pdb …

`--own` uses the grid and the radii of pyKVFinder instead.
"""

import logging
import sys
import time
from pathlib import Path

import numpy as np
import pyKVFinder as kv

STEP, PROBE_IN, PROBE_OUT, REMOVAL, CUTOFF = 0.6, 1.4, 4.0, 2.4, 5.0


def polymer(path):
    """Returns the compared atoms in the form of pyKVFinder."""
    from prepare import heavy  # Its package would add to the memory that package_peer.py measures.
    from radii import RADII

    structure = heavy(path)  # rows point into it
    return np.array([
        [str(row.residue.seqid), row.chain.name, row.residue.name, row.atom.name, *map(str, row.atom.pos.tolist()),
         str(RADII[row.atom.element.name.upper()])] for row in structure[0].all()
    ])  # fmt: skip


def anchored(places):
    """Corners of a box whose grid points lie at multiples of the step."""
    low = np.floor((places.min(axis=0) - 8.0) / STEP) * STEP
    high = np.ceil((places.max(axis=0) + 8.0) / STEP) * STEP
    return np.array([low] + [np.where(np.arange(3) == k, high, low) for k in range(3)])


def detect(atoms, corners, threads):
    """Returns the number of pockets and the grid with their numbers."""
    return kv.detect(atoms, corners, STEP, PROBE_IN, PROBE_OUT, REMOVAL, CUTOFF, nthreads=threads)


def describe(n, grid, threads):
    """Returns volumes, areas, depths and openings of pockets by name."""
    if n == 0:
        return {}, {}, {}, {}
    _, volumes, areas = kv.spatial(grid, STEP, nthreads=threads)
    depths, deepest, _ = kv.depth(grid, STEP, nthreads=threads)
    _, _, opened = kv.openings(grid, depths, STEP, openings_cutoff=1, nthreads=threads)
    return volumes, areas, deepest, opened


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
        n, grid = detect(atoms, corners, 2)
        seconds = time.perf_counter() - start
        print(f"{path.name}: {len(atoms)} atoms, {n} pockets, {seconds:.2f} s")
        volumes, areas, deepest, opened = describe(n, grid, 2)
        for name in sorted(volumes, key=volumes.get, reverse=True):
            holes = len(opened.get(name, {}))
            print(f"  {volumes[name]:.2f} Å³, {areas[name]:.2f} Å², depth {deepest[name]:.2f} Å, {holes} openings")


if __name__ == "__main__":
    main()
