"""Follows area and volume along a trajectory in MDAnalysis, several frames at once.

Needs: the packages molmesh and MDAnalysis
"""

import os
import sys
from concurrent.futures import ThreadPoolExecutor

import MDAnalysis
import numpy as np
from MDAnalysis.guesser.tables import vdwradii

import molmesh

universe = MDAnalysis.Universe(*sys.argv[1:] or ["samples/4pti.pdb"])
protein = universe.select_atoms("protein")
if len(universe.trajectory) == 1:
    # A file without a trajectory: the molecule expands by 10 %.
    middle = universe.atoms.positions.mean(axis=0)
    frames = [middle + (universe.atoms.positions - middle) * scale for scale in np.linspace(1, 1.1, 5)]
    universe.load_new(np.array(frames))
radii = np.array([vdwradii[element.upper()] for element in protein.elements])

# Positions of all frames, as the threads must not move the trajectory.
positions = [protein.positions.astype(float) for _ in universe.trajectory]


def measure(coordinates):
    return molmesh.surface(coordinates, radii, surface="ses", resolution=1, atom_ids=False)


with ThreadPoolExecutor(os.cpu_count()) as pool:
    meshes = list(pool.map(measure, positions))
for frame, mesh in enumerate(meshes):
    print(f"frame {frame}: {mesh.area:.0f} Å², {mesh.volume:.0f} Å³, closed {mesh.closed}")
assert all(mesh.closed for mesh in meshes)
assert sys.argv[1:] or np.all(np.diff([mesh.volume for mesh in meshes]) > 0)
