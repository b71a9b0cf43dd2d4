"""Replaces a call of MSMS: the same atoms in; vertices, normals, atoms, triangles and types of patches out.

`msms -if FILE.xyzrn -of OUT -probe_radius 1.5 -density 3` writes these arrays to OUT.vert and OUT.face, with indices
from 1 instead of 0. Needs: the packages molmesh and scipy
"""

import sys

import numpy as np
from scipy.spatial import cKDTree

import molmesh

TORIC, REENTRANT, CONTACT = 1, 2, 3  # Types of MSMS.


def msms(coordinates, radii, probe=1.5, density=3.0):
    """Returns vertices, normals, nearest atoms, types of vertices, triangles, and types of triangles."""
    resolution = (1.5 / density) ** 0.5  # A grid gives 1.5 vertices per square of its spacing.
    mesh = molmesh.surface(coordinates, radii, surface="ses", probe=probe, resolution=resolution)
    # Normals point to the centre of the probe, which touches one atom, two, or more.
    probes = mesh.vertices + probe * mesh.normals
    most = radii.max() + probe + 0.01
    reach = cKDTree(probes).sparse_distance_matrix(cKDTree(coordinates), most, output_type="ndarray")
    touches = reach["v"] < radii[reach["j"]] + probe + 1e-3
    n_touched = np.bincount(reach["i"][touches], minlength=len(probes))
    types = np.array([CONTACT, CONTACT, TORIC, REENTRANT])[np.minimum(n_touched, 3)]
    # A triangle between patches belongs to that of its median vertex.
    return mesh.vertices, mesh.normals, mesh.atom, types, mesh.faces, np.sort(types[mesh.faces], axis=1)[:, 1]


structure = molmesh.read(*sys.argv[1:] or ["samples/4pti.pdb"])
vertices, normals, atoms, types, faces, face_types = msms(structure.coordinates, structure.radii)
a, b, c = vertices[faces].transpose(1, 0, 2)
face_areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
exact = molmesh.areas(structure, surface="ses", probe=1.5, by="chain")
for name, kind in [("contact", CONTACT), ("toroidal", TORIC), ("concave", REENTRANT)]:
    found, expected = (face_areas[:, None] / 3 * (types[faces] == kind)).sum(), exact[name].sum()
    print(f"{name}: {found:.0f} Å², exact {expected:.0f} Å²")
    assert abs(found / expected - 1) < 0.05
