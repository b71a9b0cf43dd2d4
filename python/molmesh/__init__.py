"""Watertight molecular-surface meshes as numpy arrays.

Reads PDB, mmCIF, BinaryCIF, PQR and XYZ files, plain or compressed with gzip or zstd. All lengths are ångström (Å).
`Client` and `AsyncClient` use a service.

>>> import molmesh
>>> mesh = molmesh.surface("samples/4pti.pdb", surface="ses")
>>> mesh.vertices.shape[1], mesh.faces.shape[1]
(3, 3)
>>> mesh.save("4pti.glb")
"""

from ._molmesh import (
    PARAMETERS,
    Cavity,
    Error,
    Mesh,
    Pocket,
    Structure,
    __version__,
    areas,
    cavities,
    pockets,
    read,
    render,
    surface,
)

_CLIENTS = ["AsyncBatch", "AsyncClient", "AsyncJob", "Batch", "Client", "Job", "MapResult"]

__all__ = [
    "PARAMETERS",
    "Cavity",
    "Error",
    "Mesh",
    "Pocket",
    "Structure",
    "__version__",
    "areas",
    "cavities",
    "pockets",
    "read",
    "render",
    "surface",
    *_CLIENTS,
]


def __getattr__(name):
    """Imports the clients at their first use: the HTTP library takes longer to import than the rest."""
    if name not in _CLIENTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import _client

    globals().update((client, getattr(_client, client)) for client in _CLIENTS)
    return globals()[name]


def __dir__():
    return sorted({*globals(), *_CLIENTS})
