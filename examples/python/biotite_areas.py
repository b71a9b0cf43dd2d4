"""Measures the atoms of a biotite AtomArray: exact areas without a file, and their sums by residue.

Needs: the packages molmesh and biotite
"""

import sys

import biotite.structure as struc
from biotite.structure.io import pdb
import numpy as np
from biotite.structure.info import vdw_radius_single

import molmesh

atoms = pdb.PDBFile.read(*sys.argv[1:] or ["samples/4pti.pdb"]).get_structure(model=1)
atoms = atoms[struc.filter_amino_acids(atoms)]
radii = np.array([vdw_radius_single(element) for element in atoms.element])

areas = molmesh.areas(atoms.coord, radii, surface="sas", probe=1.4)["area"]
by_residue = struc.apply_residue_wise(atoms, areas, np.sum)
numbers, names = struc.get_residues(atoms)
for k in np.argsort(-by_residue)[:3]:
    print(f"{names[k]} {numbers[k]}: {by_residue[k]:.1f} Å²")

# The estimate of biotite approaches the exact areas as its number of points grows.
estimate = struc.sasa(atoms, probe_radius=1.4, point_number=2000, vdw_radii=radii, ignore_ions=False)
print(f"total {areas.sum():.1f} Å², estimated {estimate.sum():.1f} Å²")
assert np.isclose(areas.sum(), estimate.sum(), rtol=2e-3) and np.abs(areas - estimate).max() < 1
assert np.isclose(by_residue.sum(), areas.sum())
