"""Installs the peers from their registries into `target/peers`, unless they are present.

Nothing is installed into the system; Debian packages are only unpacked. Raises `Missing` with the reason on failure.
"""

import functools
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "target/peers"
NODE, VENV, DEBIAN = FOLDER / "node", FOLDER / "venv", FOLDER / "debian"
PINS = Path(__file__).with_name("requirements.txt")
SPLASHSURF, MOLSTAR = "0.14.1", "5.11.0"
# For preparing structures and checking meshes.
BASE = ("gemmi", "numpy", "trimesh", "scipy")


class Missing(Exception):
    """Reason why a peer is not available."""


def call(command, **options):
    """Runs a command silently. The last line of its output is the reason if it fails."""
    print(f"installing: {' '.join(map(str, command))}", file=sys.stderr, flush=True)
    try:
        done = subprocess.run([*map(str, command)], capture_output=True, text=True, **options)
    except OSError as error:
        raise Missing(str(error)) from error
    if done.returncode != 0:
        words = (done.stderr.strip() or done.stdout.strip()).splitlines() or ["no output"]
        raise Missing(f"{Path(str(command[0])).name} failed: {words[-1].strip()}")
    return done.stdout


def output_of(command, environment=None):
    """Returns the output of a command without surrounding white space."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **(environment or {})})
    except OSError as error:
        raise Missing(str(error)) from error
    if done.returncode != 0:
        raise Missing(f"{Path(command[0]).name} failed: {done.stderr.strip()[-200:]}")
    return done.stdout.strip()


def has(interpreter, names):
    code = "import importlib.metadata as m, sys; [m.version(n) for n in sys.argv[1:]]"
    try:
        return subprocess.run([interpreter, "-c", code, *names], capture_output=True).returncode == 0
    except OSError:
        return False


def python():
    """Returns the Python interpreter of the peers."""
    return str(VENV / "bin/python")


def pip(names):
    if not Path(python()).exists():
        call([sys.executable, "-m", "venv", VENV])
    call([python(), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-c", PINS, *names])


@functools.cache
def helper():
    """Returns a Python interpreter to prepare structures and check meshes: this one, that of the tests, or that of the
    peers."""
    for candidate in (sys.executable, str(ROOT / "target/test-tools/venv/bin/python"), python()):
        if has(candidate, BASE):
            return candidate
    pip(BASE)
    return python()


def packages(*names):
    """Returns a function that installs Python packages if necessary and returns their versions."""
    def ready():
        wanted = [*names, *BASE]
        if not has(python(), wanted):
            try:
                pip(wanted)
            except Missing as error:
                pins = [line for line in PINS.read_text().split() if line.split("==")[0] in names]
                raise Missing(f"{', '.join(pins)}: {error}") from error
        code = "import importlib.metadata as m, sys; print(', '.join(n + ' ' + m.version(n) for n in sys.argv[1:]))"
        return output_of([python(), "-c", code, *names, "numpy"])

    return ready


def wheel(file):
    """Returns a function that installs a wheel, also instead of another one of the same version, and returns its
    version."""
    def ready():
        pip([file])
        pip(["--force-reinstall", "--no-deps", file])
        return packages(file.name.split("-")[0])()

    return ready


def splashsurf():
    own = FOLDER / "cargo/bin/splashsurf"
    return str(own) if own.exists() else shutil.which("splashsurf") or ""


def splashsurf_version():
    if not splashsurf():
        call(["cargo", "install", "splashsurf", "--version", SPLASHSURF, "--locked", "--root", FOLDER / "cargo"])
    return output_of([splashsurf(), "--version"])


def molstar_version():
    package = NODE / "node_modules/molstar/package.json"
    if not package.exists():
        NODE.mkdir(parents=True, exist_ok=True)
        call(["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", f"molstar@{MOLSTAR}"], cwd=NODE)
    version = output_of(["node", "-p", f"require({str(package)!r}).version"])
    return f"molstar {version}, node {output_of(['node', '--version'])}"


def edtsurf():
    own = DEBIAN / "usr/bin/EDTSurf"
    return str(own) if own.exists() else shutil.which("EDTSurf") or ""


def pymol_environment():
    """Returns the environment of an unpacked PyMOL; empty if the system has it."""
    libraries, modules = DEBIAN / f"usr/lib/{platform.machine()}-linux-gnu", DEBIAN / "usr/lib/python3/dist-packages"
    if not (modules / "pymol").exists():
        return {}
    return {
        "LD_LIBRARY_PATH": f"{libraries}:{libraries}/blas:{libraries}/lapack",
        "PYTHONPATH": str(modules),
        "PYMOL_PATH": str(modules / "pymol"),
        "PYMOL_DATA": str(DEBIAN / "usr/share/pymol/data"),
        "CHEMPY_DATA": str(DEBIAN / "usr/share/pymol/data/chempy"),
    }


def debian(name):
    """Returns a function that unpacks a Debian package with its missing dependencies and returns its version."""
    def ready():
        stamp = DEBIAN / f".{name}"
        if not stamp.exists():
            if not shutil.which("apt-get"):
                raise Missing("a Debian package, but apt-get is not installed")
            plan = call(["apt-get", "--simulate", "--no-install-recommends", "install", name])
            wanted = [line.split()[1] for line in plan.splitlines() if line.startswith("Inst ")]
            DEBIAN.mkdir(parents=True, exist_ok=True)
            if name not in wanted:  # the system has it
                stamp.write_text(output_of(["dpkg", "--status", name]))
                return version(name, stamp)
            archives = FOLDER / "debs" / name
            archives.mkdir(parents=True, exist_ok=True)
            call(["apt-get", "download", *wanted], cwd=archives)
            for archive in sorted(archives.glob("*.deb")):
                call(["dpkg", "-x", archive, DEBIAN])
            shutil.rmtree(archives)
            stamp.write_text(output_of(["apt-cache", "show", "--no-all-versions", name]))
        return version(name, stamp)

    return ready


def version(name, stamp):
    """Returns name and version from the description of a package."""
    line = next(line for line in stamp.read_text().splitlines() if line.startswith("Version: "))
    return f"{name} {line.removeprefix('Version: ')}"


def molmesh_version(binary):
    return output_of([str(binary), "--version"])
