"""Compares molmesh with splashsurf on the CPU, in turn, on a RAM disk.

    python3 benches/peers/splashsurf.py FILE [FILE ...] [--runs 7] [--resolution 0.5] [--molmesh PROGRAM ...]

Requires `make static` or `make release` (measures both if both exist), `cargo install splashsurf` and the Python
package gemmi. splashsurf does not read structures. Its input are the heavy atoms of the same selection as 32-bit
coordinates, so its time does not include reading a structure. For machines without gemmi, `--points` writes these
coordinates beside each file, as FILE.xyz. Existing ones are used. All programs are copied first, because short runs of
a binary that a linker has just written take up to a sixth longer. Prints one row per file and program: medians of wall
time and peak memory, triangles, and ratios, also per triangle. The last line is the time of `true`, a program that does
nothing.
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

ROOT = Path(__file__).resolve().parents[2]


def run(command):
    """Runs a command that must succeed. Returns its wall time (s) and peak memory (MB)."""
    started = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    complaint = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - started
    if status != 0:
        sys.exit(f"{command[0]} failed: {complaint.decode(errors='replace')}")
    return wall, usage.ru_maxrss / 1024


def heavy_atoms(path):
    """Yields the coordinates that molmesh meshes by default: first model, ATOM records, no hydrogens, one alternative
    location."""
    import gemmi  # Not needed if there are files of coordinates.

    model = gemmi.read_structure(str(path))[0]
    for residue in (residue for chain in model for residue in chain if residue.het_flag == "A"):
        for atom in residue:
            if not atom.element.is_hydrogen and atom.altloc in ("\0", "A"):
                yield tuple(atom.pos)


def triangles(path):
    """Returns the number of faces in the header of a PLY file."""
    with open(path, "rb") as file:
        for line in file:
            if line.startswith(b"element face"):
                return int(line.split()[2])
    return 0


def named(program):
    """Returns the path of a program, relative to the root of the repository if it is below it."""
    return program.relative_to(ROOT) if program.is_relative_to(ROOT) else program


def coordinates(file, structure):
    """Returns the coordinates as bytes, from the file beside `file` if it exists."""
    beside = file.with_name(file.name + ".xyz")
    if beside.exists():
        return beside.read_bytes()
    return b"".join(struct.pack("<3f", *p) for p in heavy_atoms(structure))


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("files", nargs="+", type=Path)
    arguments.add_argument("--runs", type=int, default=7)
    arguments.add_argument("--resolution", type=float, default=0.5)
    arguments.add_argument("--molmesh", nargs="+", type=Path)
    arguments.add_argument("--points", action="store_true", help="only write the coordinates beside the files")
    options = arguments.parse_args()
    if options.points:
        for file in options.files:
            file.with_name(file.name + ".xyz").write_bytes(coordinates(file, file))
        return
    splashsurf = shutil.which("splashsurf") or sys.exit("splashsurf is not installed: cargo install splashsurf")
    usual = [path for path in (ROOT / "dist/molmesh", ROOT / "target/release/molmesh") if path.exists()]
    programs = options.molmesh or usual or sys.exit("molmesh is not built: make static, or make release")
    ram = "/dev/shm" if os.path.isdir("/dev/shm") else None
    print("| structure | atoms | program | molmesh s | splashsurf s | times faster | per triangle | molmesh MB | splashsurf MB |"
          " memory | molmesh triangles | splashsurf triangles |")
    print("|---" * 12 + "|")
    with tempfile.TemporaryDirectory(dir=ram) as folder, tempfile.TemporaryDirectory() as installed:
        folder = Path(folder)
        splashsurf = shutil.copy(splashsurf, installed)
        # Copies have unique names, as all programs may have the same name.
        ours = {program: shutil.copy(program, Path(installed) / str(i)) for i, program in enumerate(programs)}
        for file in options.files:
            data = gzip.open(file).read() if file.suffix == ".gz" else file.read_bytes()
            structure = folder / file.name.removesuffix(".gz")
            structure.write_bytes(data)
            points, glb, theirs = folder / "points.xyz", folder / "ours.glb", folder / "theirs.ply"
            points.write_bytes(coordinates(file, structure))
            atoms = points.stat().st_size // 12
            mesh = ["mesh", str(structure), "--resolution", str(options.resolution), "--backend", "cpu", "--quiet", "-o"]
            peer = [splashsurf, "reconstruct", str(points), "-r", "1", "-l", "1.7", "-c", str(options.resolution),
                    "-t", "0.15", "--normals=on", "-q", "-o", str(theirs)]
            rows = {program: [] for program in programs}
            for _ in range(options.runs + 1):
                for program, copy in ours.items():
                    rows[program].append(run([copy, *mesh, str(glb)]) + run(peer))
            for program, copy in ours.items():
                timed = rows[program][1:]
                walls = [statistics.median(column) for column in zip(*timed)]
                run([copy, *mesh, str(folder / "ours.ply")])
                counts = triangles(folder / "ours.ply"), triangles(theirs)
                ratio = statistics.median(row[2] / row[0] for row in timed)
                print(f"| {structure.name} | {atoms} | {named(program)} | {walls[0]:.4f} | {walls[2]:.4f} | {ratio:.2f} |"
                      f" {ratio * counts[0] / counts[1]:.2f} | {walls[1]:.0f} | {walls[3]:.0f} |"
                      f" {walls[1] / walls[3]:.2f} | {counts[0]} | {counts[1]} |", flush=True)
            for path in folder.iterdir():
                path.unlink()
    nothing = statistics.median(run(["true"])[0] for _ in range(51))
    print(f"\nA program that does nothing takes {nothing:.4f} s.")


if __name__ == "__main__":
    main()
