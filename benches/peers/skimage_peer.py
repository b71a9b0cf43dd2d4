"""Meshes a structure file with numba and the marching cubes of scikit-image: `skimage_peer.py IN OUT SPACING` writes
PLY."""

import sys

from skimage.measure import marching_cubes

import field
import ply

source, target, spacing = sys.argv[1], sys.argv[2], float(sys.argv[3])
density, origin = field.dense(*field.read(source), spacing)
vertices, faces, normals, _ = marching_cubes(density, 1.0, spacing=(spacing,) * 3, gradient_direction="ascent")
ply.write(target, vertices + origin, faces, normals)
