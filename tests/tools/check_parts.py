"""Checks the parts of meshes independently: reads nodes of glTF files and groups of OBJ files with trimesh.

Reads file names from the arguments, or one per line from standard input. Prints one line of JSON for each file: name,
watertight, faces, unused vertices, area and volume of every part, ordered by name.
"""

import json
import sys

import numpy as np
import trimesh


def parts(path):
    """Returns the parts with their names, in the coordinates of the file."""
    if path.endswith(".obj"):
        scene = trimesh.load_scene(path, process=False, maintain_order=True, split_objects=True, split_groups=True)
    else:
        scene = trimesh.load_scene(path, process=False)
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name].copy()
        part.apply_transform(transform)
        yield node, part


def report(path):
    found = []
    for name, part in parts(path):
        found.append(
            {
                "name": name,
                "watertight": bool(part.is_watertight and part.is_winding_consistent),
                "faces": len(part.faces),
                "unused": int(len(part.vertices) - len(np.unique(part.faces))),
                "area": float(part.area),
                "volume": float(part.volume),
            }
        )
    return sorted(found, key=lambda part: part["name"])


for line in sys.argv[1:] or sys.stdin:
    print(json.dumps(report(line.rstrip("\n"))), flush=True)
