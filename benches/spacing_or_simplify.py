"""File sizes of coarser grids and of simplified meshes at the same deviation from the surface.

    pip install numpy scipy trimesh
    python benches/spacing_or_simplify.py target/release/molmesh 1a0q.pdb.gz

Prints a table in Markdown. The reference is a mesh with a spacing of 0.2 Å. The deviation is the root mean square of
distances in both directions, from 300,000 random points on one mesh to the tangent plane of the nearest of 3 million
points on the other one. Times are medians of 5 commands.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

REFERENCE = ["--resolution", "0.2"]
CASES = [["--resolution", "0.7"], ["--simplify", "0.2"], ["--resolution", "1"], ["--simplify", "0.5"]]
FEW, MANY = 300_000, 3_000_000


class Surface:
    """Random points on a mesh, with their normals."""

    def __init__(self, file):
        mesh = trimesh.load(file, process=False)
        points, faces = trimesh.sample.sample_surface(mesh, MANY, seed=1)
        self.n_triangles, self.points, self.normals = len(mesh.faces), np.asarray(points), mesh.face_normals[faces]
        self.tree = cKDTree(self.points)

    def distances(self, other):
        """Returns the distances of points of the other surface from this one, Å."""
        points = other.points[:FEW]
        nearest = self.tree.query(points)[1]
        return np.abs(((points - self.points[nearest]) * self.normals[nearest]).sum(axis=1))


def main():
    binary, structure = sys.argv[1:]
    folder = Path(tempfile.mkdtemp())

    def mesh(options, name):
        file, start = folder / name, time.perf_counter()
        subprocess.run([binary, "mesh", structure, "-o", file, *options], check=True, capture_output=True)
        return file, time.perf_counter() - start

    reference = Surface(mesh(REFERENCE, "reference.stl")[0])
    print("| parameter | triangles | GLB, MB | deviation, Å | time, s |\n|---|---|---|---|---|")
    for options in CASES:
        surface = Surface(mesh(options, "mesh.stl")[0])
        distances = np.concatenate([reference.distances(surface), surface.distances(reference)])
        times = [mesh([*options, "--compress", "meshopt"], "mesh.glb")[1] for _ in range(5)]
        megabytes = (folder / "mesh.glb").stat().st_size / 1e6
        name = "=".join(options).removeprefix("--")
        deviation, seconds = np.sqrt((distances**2).mean()), statistics.median(times)
        print(f"| `{name}` | {surface.n_triangles:,} | {megabytes:.2f} | {deviation:.3f} | {seconds:.2f} |")


if __name__ == "__main__":
    main()
