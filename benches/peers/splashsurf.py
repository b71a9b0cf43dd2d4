"""Structure file to surface file, molmesh against splashsurf, in turn, on a RAM disk.

    python3 benches/peers/splashsurf.py FILE [FILE ...] [--runs 7] [--resolution 0.5]

Needs `cargo build --release`, `cargo install splashsurf` and the Python package gemmi. splashsurf has no reader of
structures: it is given the heavy atoms of the same selection as 32-bit coordinates, written beforehand, so its time
lacks reading the structure. Prints one row a file: medians of the wall time, peak memory of the process, triangles,
and the ratios, per triangle too.
"""

import argparse
import gzip
import os
import shutil
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gemmi

ROOT = Path(__file__).resolve().parents[2]


def run(command):
    """Wall seconds and peak memory (MB) of a command that must succeed."""
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    complaint = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - started
    if status != 0:
        sys.exit(f"{command[0]} failed: {complaint.decode(errors='replace')}")
    return wall, usage.ru_maxrss / 1024


def heavy_atoms(path):
    """Coordinates of what molmesh meshes by default: first model, ATOM records, no hydrogens, one alternative."""
    model = gemmi.read_structure(str(path))[0]
    for residue in (residue for chain in model for residue in chain if residue.het_flag == "A"):
        for atom in residue:
            if not atom.element.is_hydrogen and atom.altloc in ("\0", "A"):
                yield tuple(atom.pos)


def triangles(path):
    """Faces of a PLY file, from its header."""
    with open(path, "rb") as file:
        for line in file:
            if line.startswith(b"element face"):
                return int(line.split()[2])
    return 0


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("files", nargs="+", type=Path)
    arguments.add_argument("--runs", type=int, default=7)
    arguments.add_argument("--resolution", type=float, default=0.5)
    options = arguments.parse_args()
    molmesh = ROOT / "target/release/molmesh"
    splashsurf = shutil.which("splashsurf") or sys.exit("splashsurf is not installed: cargo install splashsurf")
    ram = "/dev/shm" if os.path.isdir("/dev/shm") else None
    print("| structure | atoms | molmesh s | splashsurf s | times faster | per triangle | molmesh MB | splashsurf MB |"
          " memory | molmesh triangles | splashsurf triangles |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory(dir=ram) as folder:
        folder = Path(folder)
        for file in options.files:
            data = gzip.open(file).read() if file.suffix == ".gz" else file.read_bytes()
            structure = folder / file.name.removesuffix(".gz")
            structure.write_bytes(data)
            atoms = list(heavy_atoms(structure))
            points, ours, theirs = folder / "points.xyz", folder / "ours.glb", folder / "theirs.ply"
            points.write_bytes(b"".join(struct.pack("<3f", *p) for p in atoms))
            mesh = [str(molmesh), "mesh", str(structure), "--resolution", str(options.resolution), "--quiet", "-o"]
            peer = [splashsurf, "reconstruct", str(points), "-r", "1", "-l", "1.7", "-c", str(options.resolution),
                    "-t", "0.15", "--normals=on", "-q", "-o", str(theirs)]
            rows = []
            for _ in range(options.runs + 1):
                rows.append(run(mesh + [str(ours)]) + run(peer))
            walls = [statistics.median(column) for column in zip(*rows[1:])]
            run(mesh + [str(folder / "ours.ply")])
            counts = triangles(folder / "ours.ply"), triangles(theirs)
            ratio = statistics.median(row[2] / row[0] for row in rows[1:])
            print(f"| {structure.name} | {len(atoms)} | {walls[0]:.4f} | {walls[2]:.4f} | {ratio:.2f} |"
                  f" {ratio * counts[0] / counts[1]:.2f} | {walls[1]:.0f} | {walls[3]:.0f} |"
                  f" {walls[1] / walls[3]:.2f} | {counts[0]} | {counts[1]} |", flush=True)
            for path in folder.iterdir():
                path.unlink()


if __name__ == "__main__":
    main()
