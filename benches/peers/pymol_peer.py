"""Meshes a structure file with PyMOL: `pymol -cqk pymol_peer.py -- IN OUT SPACING ses|gaussian` writes OBJ.

`ses` is the surface of `show surface` at quality 1, with 0.5 Å between dots. `gaussian` is an isosurface of a Gaussian
map: atomic scattering, blurred to 3 Å with the same B factor for all atoms, at one standard deviation of the map.
"""

import sys

from pymol import cmd

source, target, spacing, kind = sys.argv[-4:]
cmd.load(source, "m")
cmd.hide("everything")
if kind == "ses":
    cmd.set("surface_quality", 1)
    cmd.show("surface", "m")
else:
    cmd.alter("m", "b=20")
    cmd.set("gaussian_resolution", 3.0)
    cmd.map_new("g", "gaussian", float(spacing), "m", 5.0)
    cmd.isosurface("s", "g", 1.0)
cmd.save(target)
