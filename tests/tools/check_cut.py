"""Checks meshes that are cut by atoms independently, with trimesh.

Reads names of GLB, glTF, PLY, STL or OBJ files from the arguments, or one per line from standard input. Prints one line
of JSON for each file: the watertightness of every part, and faces, area, watertightness and boundary edges of all parts
together, in which vertices at the same position are one.
"""

import json
import sys

import numpy as np
import trimesh


def parts(path):
    """Returns the parts in the coordinates of the file."""
    scene = trimesh.load_scene(path, process=False)
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name].copy()
        part.apply_transform(transform)
        yield trimesh.Trimesh(part.vertices, part.faces, process=False)


def report(path):
    found = list(parts(path))
    vertices = np.concatenate([part.vertices for part in found])
    starts = np.cumsum([0] + [len(part.vertices) for part in found[:-1]])
    faces = np.concatenate([part.faces + start for part, start in zip(found, starts)])
    # Equal rows only: neighbouring vertices must not merge.
    unique, inverse = np.unique(vertices, axis=0, return_inverse=True)
    joined = trimesh.Trimesh(unique, inverse.reshape(-1)[faces], process=False)
    edges = np.sort(joined.edges, axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return {
        "watertight_parts": [bool(part.is_watertight) for part in found],
        "faces": len(faces),
        "area": float(joined.area),
        "watertight": bool(joined.is_watertight and joined.is_winding_consistent),
        "oriented": bool(joined.is_winding_consistent),
        "boundary_edges": int((counts == 1).sum()),
    }


for line in sys.argv[1:] or sys.stdin:
    print(json.dumps(report(line.rstrip("\n"))), flush=True)
