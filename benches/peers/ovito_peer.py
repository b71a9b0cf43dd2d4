"""Meshes a structure file with the Gaussian density surface of OVITO: `ovito_peer.py IN OUT SPACING` writes PLY.

The density of OVITO is Σ exp(−d²/2σ²), where σ is a radius times `radius_scaling`; ours is Σ exp(−a(d²/r² − 1)) at 1.
With our radii, σ = r/√(2a) and the isovalue exp(−a), the surface is the same except for the cut-offs. The grid is
specified by the number of cells along the longest side of the bounding box, which OVITO enlarges by three σ of the
largest radius.
"""

import math
import sys

import numpy as np
from ovito.io import import_file
from ovito.modifiers import ConstructSurfaceModifier

import ply
from radii import RADII

SMOOTHNESS = 1.25
source, target, spacing = sys.argv[1], sys.argv[2], float(sys.argv[3])
scaling = 1 / math.sqrt(2 * SMOOTHNESS)
pipeline = import_file(source)


def prepare(frame, data):
    """Sets our radii and removes the periodic cell."""
    for kind in data.particles_.particle_types_.types:
        data.particles_.particle_types_.type_by_id_(kind.id).radius = RADII[kind.name.upper()]
    if data.cell is not None:
        data.cell_.pbc = (False, False, False)


pipeline.modifiers.append(prepare)
positions = np.asarray(pipeline.compute().particles.positions)
side = np.ptp(positions, axis=0).max() + 2 * 3 * max(RADII.values()) * scaling
pipeline.modifiers.append(
    ConstructSurfaceModifier(
        method=ConstructSurfaceModifier.Method.GaussianDensity,
        grid_resolution=round(side / spacing),
        radius_scaling=scaling,
        isolevel=math.exp(-SMOOTHNESS),
    )
)
mesh = pipeline.compute().surfaces["surface"]
ply.write(target, mesh.get_vertices(), mesh.get_faces())
