"""Makes a PyVista mesh with the B-factor of the nearest atom at each vertex, cuts it, and writes a file.

Needs: the packages molmesh and pyvista
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pyvista

import molmesh

structure = molmesh.read(*sys.argv[1:] or ["samples/4pti.pdb"])
mesh = molmesh.surface(structure, surface="ses", resolution=0.7)
surface = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)
surface.point_data["b_factor"] = structure.b_factors[mesh.atom]
surface.point_data.active_normals = mesh.normals
print(f"{surface.n_points} points, {surface.area:.1f} Å², {surface.volume:.1f} Å³")
assert surface.is_manifold and np.isclose(surface.volume, mesh.volume, rtol=1e-3)

# `surface.plot(scalars="b_factor")` opens a window.
half = surface.clip("x", origin=surface.center)
outline = surface.slice("x", origin=surface.center)
assert 0 < half.area < surface.area and outline.length > 0
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "surface.vtp"
    surface.save(path)
    assert np.array_equal(pyvista.read(path)["b_factor"], structure.b_factors[mesh.atom])
