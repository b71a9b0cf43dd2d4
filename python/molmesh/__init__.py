"""Watertight molecular-surface meshes as numpy arrays.

Reads PDB, mmCIF, BinaryCIF, PQR and XYZ files, plain or compressed with gzip or zstd. All lengths are ångström (Å).

>>> import molmesh
>>> mesh = molmesh.surface("samples/4pti.pdb", surface="ses")
>>> mesh.vertices.shape[1], mesh.faces.shape[1]
(3, 3)
>>> mesh.save("4pti.glb")
"""

from ._molmesh import PARAMETERS, Error, Mesh, Structure, __version__, areas, read, render, surface

__all__ = ["PARAMETERS", "Error", "Mesh", "Structure", "__version__", "areas", "read", "render", "surface"]
