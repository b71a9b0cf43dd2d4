"""Checks meshes of large structures with trimesh, against the reports of the program.

Usage: nightly.py BINARY FOLDER [NAME…]

Meshes every structure of FOLDER, or those whose file names begin with a NAME. Structures with fewer than 5,000 meshed
atoms are left to the tests that run every time. Prints one line per structure; exit code 1 after a difference.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from check_mesh import report

# Below this number of meshed atoms, `make test` checks structures.
SMALL = 5000
# Allowed relative difference of area and volume.
TOLERANCE = 1e-6
# The spacing grows with the structure: at most 3 million triangles, of which trimesh needs 1 KiB each.
SURFACE = ["--detail", "4", "--validation", "exact"]
# Exit code of `molmesh` for a structure that it rejects, such as one without atoms.
REJECTED = 4


def faults(measured, reported):
    """Returns the differences between the measures of trimesh and those of a closed mesh in the report."""
    found = []
    if measured.get("error") or measured["empty"]:
        return [measured.get("error", "the mesh is empty")]
    for name in ["watertight", "winding_consistent"]:
        if not measured[name]:
            found.append(f"not {name}")
    for own, name in [("faces", "triangles"), ("vertices", "vertices"), ("euler", "euler"), ("bodies", "components")]:
        if measured[own] != reported[name]:
            found.append(f"{name}: {measured[own]} instead of {reported[name]}")
    for name in ["area", "volume"]:
        if not abs(measured[name] - reported[name]) <= TOLERANCE * abs(reported[name]):
            found.append(f"{name}: {measured[name]!r} instead of {reported[name]!r}")
    return found


def control(folder):
    """Checks that faults are found, with an octahedron of area 4·√3 and volume 4/3."""
    corners = ["1 0 0", "-1 0 0", "0 1 0", "0 -1 0", "0 0 1", "0 0 -1"]
    faces = ["0 2 4", "2 1 4", "1 3 4", "3 0 4", "2 0 5", "1 2 5", "3 1 5", "0 3 5"]
    reported = {"triangles": 8, "vertices": 6, "euler": 2, "components": 1, "area": 4 * 3**0.5, "volume": 4 / 3}

    def measured(faces):
        head = f"ply\nformat ascii 1.0\nelement vertex {len(corners)}\nproperty float x\nproperty float y\n"
        head += f"property float z\nelement face {len(faces)}\nproperty list uchar uint vertex_indices\nend_header\n"
        path = folder / "control.ply"
        path.write_text(head + "\n".join(corners + [f"3 {face}" for face in faces]) + "\n")
        return report(str(path))

    whole = measured(faces)
    wrong = [measured(faces[1:]), measured(["4 2 0"] + faces[1:]), whole | {"euler": 0}]
    wrong += [whole | {name: whole[name] * (1 + 1e-5)} for name in ["area", "volume"]]
    if faults(whole, reported) or not all(faults(mesh, reported) for mesh in wrong):
        sys.exit("nightly.py: the check does not distinguish right from wrong meshes")


def main():
    binary, folder, *names = sys.argv[1:]
    files = sorted(Path(folder).iterdir())
    files = [f for f in files if any(f".{ext}" in f.name for ext in ["pdb", "ent", "cif", "bcif"])]
    files = [f for f in files if not names or any(f.name.startswith(name) for name in names)]
    checked = failed = 0
    with tempfile.TemporaryDirectory() as scratch:
        control(Path(scratch))
        mesh = Path(scratch) / "mesh.glb"
        for file in files:
            command = [binary, "mesh", file, "-o", mesh, "--backend", "cpu", "--quiet", "--report", "json", *SURFACE]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode == REJECTED:
                print(f"{file.name}: rejected, {done.stderr.strip()}", flush=True)
                continue
            if done.returncode != 0:
                print(f"{file.name}: FAILED, exit code {done.returncode}: {done.stderr.strip()}", flush=True)
                failed += 1
                continue
            reported = json.loads(done.stdout)
            if reported["atoms"] < SMALL:
                continue
            found = faults(report(str(mesh)), reported)
            size = f"{reported['atoms']} atoms, {reported['triangles']} triangles, Euler number {reported['euler']}"
            print(f"{file.name}: {size}: {'FAILED, ' + '; '.join(found) if found else 'ok'}", flush=True)
            checked += 1
            failed += bool(found)
    if checked == 0:
        sys.exit(f"nightly.py: {folder} has no structure of {SMALL} or more atoms")
    print(f"{checked} structures checked, {failed} failed")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
