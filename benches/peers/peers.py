"""Compares molmesh with other programs and Python packages on the same structures, in turn, on a RAM disk.

    # The samples; then 1UBQ, 1A0Q, 7CTH and 6ZU5 of a folder, with an update of the page; then some files and programs.
    python3 benches/peers/peers.py
    python3 benches/peers/peers.py --data FOLDER --publish
    python3 benches/peers/peers.py --files A.pdb B.cif --only molmesh,splashsurf --rounds 9
    # Packages instead of programs: 1UBQ, 2HHB and 1AON of a folder.
    python3 benches/peers/peers.py --wheel dist/molmesh-….whl --data FOLDER --publish

Requires `cargo build --release` or a wheel of molmesh, Python 3.11, and the package managers of the programs (cargo,
npm, apt-get). Missing programs are installed into target/peers. A program that cannot be installed, fails or takes too
long has a row with the reason. Each run is a complete process: of a program from a file to a file, of a package several
calls, of which only these are timed. docs/research/peers.md describes the comparison.
"""

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import tables
from catalog import TASKS, Job, catalog, packages
from install import ROOT, Missing, helper

HERE = Path(__file__).resolve().parent
DEFAULT = {"peers": ("1ubq", "1a0q", "7cth", "6zu5"), "packages": ("1ubq", "2hhb", "1aon")}
SUFFIXES = (".pdb", ".ent", ".cif", ".pdb.gz", ".ent.gz", ".cif.gz")


def options():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=ROOT / "samples", help="folder of structures [samples]")
    parser.add_argument("--files", type=Path, nargs="+", help="structure files instead of --data: PDB or mmCIF, plain or gzip")
    parser.add_argument("--rounds", type=int, default=5, help="timed runs of each program [5]")
    parser.add_argument("--only", help="programs or packages, comma-separated; molmesh is always included")
    parser.add_argument("--limit", type=float, default=120, help="time limit of a run, s [120]")
    parser.add_argument("--spacing", type=float, default=0.5, help="grid spacing, Å [0.5]")
    parser.add_argument("--molmesh", type=Path, default=ROOT / "target/release/molmesh", help="molmesh binary")
    parser.add_argument("--wheel", type=Path, help="wheel of molmesh; compares Python packages instead of programs")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--page", type=Path, help="page for the tables, between its markers")
    parser.add_argument("--note", default="", help="sentence for the header of the tables, such as other load on the machine")
    parser.add_argument("--publish", action="store_true", help="write docs/research/peers.md and docs/results")
    given = parser.parse_args()
    if given.rounds < 1 or given.limit <= 0 or given.spacing <= 0:
        parser.error("--rounds, --limit and --spacing must be positive")
    if given.publish:
        given.json, given.page = ROOT / f"docs/results/{kind(given)}.json", ROOT / "docs/research/peers.md"
    return given


def kind(given):
    """Returns the name of the results and of the markers of their tables."""
    return "packages" if given.wheel else "peers"


def chosen_files(given):
    """Returns the files of `--files`, else the default structures of the folder, else all structures of the folder."""
    if given.files:
        return given.files
    there = sorted(path for path in given.data.iterdir() if path.name.lower().endswith(SUFFIXES))
    known = [path for name in DEFAULT[kind(given)] for path in there if path.name.lower().split(".")[0] == name]
    return known or there or sys.exit(f"no structures in {given.data}")


def machine():
    """Describes this machine."""
    cpu, memory = platform.processor() or platform.machine(), 0
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            cpu = line.split(":", 1)[1].strip()
    for line in Path("/proc/meminfo").read_text().splitlines():
        if line.startswith("MemTotal"):
            memory = int(line.split()[1]) / 1e6
    return {"cpu": cpu, "cores": len(os.sched_getaffinity(0)), "memory_gb": memory,
            "system": f"{platform.system()} {platform.release()}", "load": os.getloadavg()[0]}  # fmt: skip


def ask(script, *arguments):
    """Runs a script of this folder and returns its lines of JSON."""
    done = subprocess.run([helper(), str(HERE / script), *map(str, arguments)], capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"{script}: {done.stderr.strip().splitlines()[-1] if done.stderr.strip() else 'failed'}")
    return [json.loads(line) for line in done.stdout.splitlines()]


def launch(peer, job, limit):
    """Measures one run. Returns seconds and kB, or the reason for their absence (`failed`, `limit`)."""
    for old in job.folder.glob(job.target.name + "*"):
        old.unlink()
    errors = job.folder / "errors.txt"
    command = [sys.executable, "-I", "-S", str(HERE / "launch.py"), str(limit), str(errors), *peer.command(job)]
    environment = {**os.environ, **peer.environment()}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=job.folder)
    if done.returncode != 0:
        words = done.stderr.strip().splitlines()
        return {"failed": words[-1] if words else f"launch.py ended with {done.returncode}"}
    run = json.loads(done.stdout)
    mesh = Path(job.mesh(peer.extension))
    if run["late"]:
        return {"limit": limit}
    if run["status"] != 0 or not mesh.exists() or mesh.stat().st_size == 0:
        words = errors.read_text(errors="replace").strip().splitlines()
        return {"failed": f"status {run['status']}" + (f", {words[-1][:160]}" if words else "")}
    # A package measures its calls without the start of Python and the import.
    report = Path(job.mesh(".json"))
    own = json.loads(report.read_text()) if report.exists() else {}
    return {"wall": run["wall"], "kb": run["kb"], **own}


def first(peer, job, limit):
    """Runs a program once without timing and checks its mesh."""
    entry = {"surface": peer.surface}
    outcome = launch(peer, job, limit)
    if "wall" not in outcome:
        return {**entry, **outcome}
    try:
        mesh = {"area": outcome["area"]} if "area" in outcome else ask("check.py", job.mesh(peer.extension))[0]
        return {**entry, "runs": [], "mesh": mesh}
    except RuntimeError as error:
        return {**entry, "failed": str(error)}


def compare(peers, absent, job, given):
    """Measures all programs on one structure. Returns their entries by name, in the order of the catalogue."""
    programs = {}
    for peer in peers:
        if peer.name in absent:
            programs[peer.name] = {"surface": peer.surface, "missing": absent[peer.name]}
        else:
            note(f"{job.name}: {peer.name}")
            programs[peer.name] = first(peer, job, given.limit)
    running = [peer for peer in peers if "runs" in programs[peer.name]]
    for number in range(given.rounds):
        note(f"{job.name}: round {number + 1} of {given.rounds}")
        # Rotate the order, so that the predecessor of a program changes.
        for peer in running[number % len(running) :] + running[: number % len(running)] if running else []:
            entry, outcome = programs[peer.name], launch(peer, job, given.limit)
            if "wall" in outcome:
                entry["runs"].append({"round": number, **outcome})
            else:
                entry.update(outcome)
        running = [peer for peer in running if not {"failed", "limit"} & programs[peer.name].keys()]
    return tables.summary(programs)


def note(words):
    print(words, file=sys.stderr, flush=True)


def same_atoms(molmesh, structure):
    """Exits if molmesh does not mesh the same number of atoms as the other programs."""
    command = [molmesh, "mesh", structure["file"], "--backend", "cpu", "--report", "json", "-o", os.devnull, "--format", "ply"]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(done.stderr.strip())
    atoms = json.loads(done.stdout)["atoms"]
    if atoms != structure["atoms"]:
        sys.exit(f"{structure['name']}: molmesh meshes {atoms} atoms, the others {structure['atoms']}")


def ready(peers):
    """Returns versions by name, and the reasons for missing programs."""
    versions, absent = {}, {}
    for peer in {peer.name: peer for peer in peers}.values():
        try:
            versions[peer.name] = peer.ready()
        except Missing as error:
            absent[peer.name] = str(error)
    return versions, absent


def main():
    given = options()
    groups = [(None, catalog(given.molmesh.resolve()))]
    if given.wheel:
        cores = sorted({1, len(os.sched_getaffinity(0))})
        groups = [(n, packages(given.wheel.resolve(), task, n)) for task in TASKS for n in cores]
    peers = [peer for _, group in groups for peer in group]
    if given.only:
        names = {"molmesh", *given.only.split(",")}
        unknown = names - {peer.name for peer in peers}
        if unknown:
            there = dict.fromkeys(peer.name for peer in peers)
            sys.exit(f"no such program: {', '.join(sorted(unknown))}; there are {', '.join(there)}")
        groups = [(n, [peer for peer in group if peer.name in names]) for n, group in groups]
        peers = [peer for peer in peers if peer.name in names]
    versions, absent = ready(peers)
    if "molmesh" in absent:
        sys.exit(f"{absent['molmesh']}: cargo build --release, or --molmesh BINARY; make wheel, or --wheel FILE")
    result = {"date": datetime.date.today().isoformat(), "machine": machine(), "spacing": given.spacing,
              "rounds": given.rounds, "limit": given.limit, "note": given.note, "versions": versions, "structures": []}  # fmt: skip
    ram = "/dev/shm" if os.path.isdir("/dev/shm") else None
    for file in chosen_files(given):
        with tempfile.TemporaryDirectory(dir=ram, prefix="peers-") as folder:
            structure = ask("prepare.py", folder, file)[0]
            if given.wheel:
                ask("atom_arrays.py", folder, structure["file"])
            else:
                same_atoms(given.molmesh, structure)
            job = Job(structure["name"], Path(structure["file"]), Path(folder), given.spacing, Path(folder) / "mesh")
            for n, group in groups:
                labels = {"cores": n} if n else {}
                programs = compare(group, absent, job, given)
                result["structures"].append({"name": structure["name"], "atoms": structure["atoms"], **labels,
                                             "load": os.getloadavg()[0], "programs": programs})  # fmt: skip
                title, rows = tables.section(result["structures"][-1])
                print(f"\n{title}\n{tables.terminal(rows)}", flush=True)
        if given.json:  # after each structure, so that an interrupted run keeps its results
            given.json.parent.mkdir(parents=True, exist_ok=True)
            given.json.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    if given.page:
        given.page.write_text(tables.between(given.page.read_text(), tables.page(result), kind(given)))


if __name__ == "__main__":
    main()
