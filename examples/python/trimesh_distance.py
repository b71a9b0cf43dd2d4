"""Measures with trimesh how deep each atom lies below the solvent-excluded surface.

Needs: the packages molmesh, trimesh and scipy
"""

import sys

import numpy as np
import trimesh

import molmesh

structure = molmesh.read(*sys.argv[1:] or ["samples/4pti.pdb"])
mesh = molmesh.surface(structure, surface="ses", resolution=0.7)
surface = mesh.to_trimesh()
print(f"{len(surface.faces)} triangles, {surface.area:.1f} Å², {surface.volume:.1f} Å³")
assert surface.is_watertight and np.isclose(surface.volume, mesh.volume, rtol=1e-5)

# The largest component is the outer surface; the others are walls of cavities.
outer = max(surface.split(only_watertight=False), key=lambda part: part.volume)
points = trimesh.sample.sample_surface(outer, 50_000, seed=1)[0]
depths = trimesh.points.PointCloud(points).kdtree.query(structure.coordinates)[0]
buried = int(np.argmax(depths))
print(f"{structure.residues['name'][buried]} {structure.names[buried]} lies {depths[buried]:.1f} Å deep")
# Triangles cut off less than 0.15 Å of the spheres, so no atom is much nearer than its radius.
assert np.all(depths > structure.radii - 0.15) and depths.max() > 5
