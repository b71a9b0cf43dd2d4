"""Checks a mesh file with trimesh: `check.py FILE` prints one line of JSON.

A mesh is closed if each edge belongs to exactly two triangles by the indices of the file. Vertices with identical
coordinates are merged only if the file shares no vertices; `merged` is true then. Edges are also counted here, and both
results must agree.
"""

import json
import sys

import numpy as np
import trimesh

CHUNK = 1 << 20


def ascii_ply(data):
    """Returns vertices and faces of a text PLY of triangles whose first three properties are coordinates."""
    head, body = data.split(b"end_header\n", 1)
    counts, widths, section = {}, {}, None
    for words in (line.split() for line in head.decode().splitlines()):
        if words[:1] == ["element"]:
            section = words[1]
            counts[section], widths[section] = int(words[2]), 0
        elif words[:1] == ["property"]:
            widths[section] += 4 if words[1] == "list" else 1
    numbers = np.fromstring(body, sep=" ")
    split = counts["vertex"] * widths["vertex"]
    vertices = numbers[:split].reshape(counts["vertex"], widths["vertex"])[:, :3]
    end = split + counts["face"] * widths["face"]
    faces = numbers[split:end].reshape(counts["face"], widths["face"])
    if not (faces[:, 0] == 3).all():
        raise ValueError("not only triangles")
    return vertices, faces[:, 1:4].astype(np.int64)


def obj(data):
    """Returns vertices and faces of an OBJ of triangles."""
    lines = data.split(b"\n")
    vertices = b" ".join(line[2:] for line in lines if line.startswith(b"v "))
    corners = [word.split(b"/")[0] for line in lines if line.startswith(b"f ") for word in line.split()[1:]]
    return np.fromstring(vertices, sep=" ").reshape(-1, 3), np.array(corners, dtype=np.int64).reshape(-1, 3) - 1


def load(path):
    """Returns vertices (N × 3, Å) and faces (M × 3) as in the file. Parses text files itself, as the readers of trimesh
    need many times their size."""
    if path.endswith(".obj"):
        with open(path, "rb") as file:
            return obj(file.read())
    if path.endswith(".ply"):
        with open(path, "rb") as file:
            if b"format ascii" in file.read(64):
                file.seek(0)
                return ascii_ply(file.read())
    mesh = trimesh.load(path, process=False, force="mesh")
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def merge(vertices, faces):
    """Merges vertices with identical coordinates."""
    rows = np.ascontiguousarray(vertices + 0.0)  # −0 is 0
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * 3))).ravel()
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return rows[first], inverse.reshape(-1)[faces]


def edges(faces, vertices):
    """Counts the edges with one triangle, and those with more than two."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = np.sort(pairs.min(axis=1) * vertices + pairs.max(axis=1))
    ends = np.flatnonzero(np.diff(keys, append=-1))
    uses = np.diff(ends, prepend=-1)
    return int((uses == 1).sum()), int((uses > 2).sum())


def area_and_volume(vertices, faces):
    """Returns area (Å²) and volume (Å³). The volume is negative for inward orientation, and not meaningful for open
    meshes."""
    area = volume = 0.0
    centre = vertices.mean(axis=0)
    for begin in range(0, len(faces), CHUNK):
        a, b, c = (vertices[faces[begin : begin + CHUNK, k]] - centre for k in range(3))
        area += np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        volume += np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    return float(area), float(volume)


def report(vertices, faces):
    """Returns the figures for the tables. Raises ValueError if the two checks of edges disagree."""
    soup = len(faces) > 0 and len(vertices) == 3 * len(faces)
    if soup:
        vertices, faces = merge(vertices, faces)
    open_edges, crowded = edges(faces, len(vertices))
    closed = bool(trimesh.Trimesh(vertices, faces, process=False).is_watertight)
    if closed != (len(faces) > 0 and open_edges == crowded == 0):
        raise ValueError(f"trimesh says closed: {closed}; edges with one triangle: {open_edges}, with more than two: {crowded}")
    area, volume = area_and_volume(vertices, faces)
    return {
        "triangles": len(faces), "vertices": len(vertices), "closed": closed, "merged": soup,
        "open_edges": open_edges, "crowded_edges": crowded, "area": area, "volume": volume,
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(report(*load(sys.argv[1]))))
