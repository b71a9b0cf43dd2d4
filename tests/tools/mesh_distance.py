"""Measures distances between meshes independently, with trimesh, numpy and scipy.

Reads the names of two mesh files, separated by a tab, from each line of standard input. Prints one line of JSON for
each: the largest distance of a point on one surface from the other, at points 0.3 apart on both, and the number of
pairs of triangles of the second file that intersect.
"""

import json
import sys

import numpy as np
import trimesh
from scipy.spatial import cKDTree

STEP = 0.3
NEIGHBOURS = 6


def load(path):
    mesh = trimesh.load_mesh(path, process=False)
    return np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces)


def points(corners, step):
    """Returns points of triangles at most `step` apart, and the number of the triangle of each."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(1, np.ceil(edges / step).astype(int))
    found, owners = [], []
    for n in np.unique(parts):
        rows = np.flatnonzero(parts == n)
        for i in range(n + 1):
            for j in range(n + 1 - i):
                weights = np.array([n - i - j, i, j]) / n
                found.append(np.einsum("k,tkx->tx", weights, corners[rows]))
                owners.append(rows)
    return np.concatenate(found), np.concatenate(owners)


def largest_distance(own, other):
    """Returns the largest distance of points of the triangles `own` from the triangles `other`."""
    places, owners = points(other, STEP)
    # Triangles share the points of their edges.
    queries = np.unique(points(own, STEP)[0].round(4), axis=0)
    _, near = cKDTree(places).query(queries, k=NEIGHBOURS)

    def distances(rows, neighbours):
        found = [trimesh.triangles.closest_point(other[owners[column]], queries[rows]) for column in neighbours.T]
        return np.min([np.linalg.norm(place - queries[rows], axis=1) for place in found], axis=0)

    # The first neighbour bounds each distance, so that few points need the others.
    bounds = distances(slice(None), near[:, :1])
    rows = np.argsort(bounds)[-1000:]
    largest = distances(rows, near[rows]).max()
    rows = np.flatnonzero(bounds > largest)
    return float(max(largest, distances(rows, near[rows]).max(initial=0)))


def intersections(vertices, faces):
    """Counts pairs of triangles of which an edge of one passes through the other."""
    corners = vertices[faces]
    middles, radii = corners.mean(axis=1), np.linalg.norm(corners - corners.mean(axis=1)[:, None], axis=2).max(axis=1)
    pairs = cKDTree(middles).query_pairs(2 * radii.max(), output_type="ndarray")
    apart = np.linalg.norm(middles[pairs[:, 0]] - middles[pairs[:, 1]], axis=1)
    pairs = pairs[apart <= radii[pairs[:, 0]] + radii[pairs[:, 1]]]
    common = (faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None, :]).sum(axis=(1, 2))
    pairs = pairs[common < 2]
    crosses = np.zeros(len(pairs), dtype=bool)
    for edge_of, through in (pairs.T, pairs.T[::-1]):
        a, b, c = (corners[through][:, k] for k in range(3))
        for k in range(3):
            ends = faces[edge_of][:, [k, (k + 1) % 3]]
            free = ~(ends[:, :, None] == faces[through][:, None, :]).any(axis=(1, 2))
            p, q = vertices[ends[:, 0]], vertices[ends[:, 1]]
            volume = lambda x, y, z, w: np.einsum("ij,ij->i", x - w, np.cross(y - w, z - w))
            sides = volume(a, b, c, p) * volume(a, b, c, q) < 0
            around = np.stack([volume(a, b, p, q), volume(b, c, p, q), volume(c, a, p, q)])
            crosses |= free & sides & ((around > 0).all(axis=0) | (around < 0).all(axis=0))
    return int(crosses.sum())


def report(first, second):
    [one, other] = [load(first), load(second)]
    [a, b] = [vertices[faces] for vertices, faces in (one, other)]
    return {
        "distance": max(largest_distance(a, b), largest_distance(b, a)),
        "intersections": intersections(*other),
    }


if __name__ == "__main__":
    for line in sys.stdin:
        print(json.dumps(report(*line.rstrip("\n").split("\t"))), flush=True)
