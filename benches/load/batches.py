#!/usr/bin/env python3
"""Measures how many structures an hour the command, Python threads and a batch of the service process.

    python3 benches/load/batches.py target/release/molmesh STRUCTURE.pdb… --files 2000 --cores 2

Writes FILES structures of 100 to 1,000 residues: runs of residues of the given PDB files, moved a little, so that no
two have the same content. For each structure, every way makes an SES mesh at 1 Å as GLB and the exact SES areas of the
residues. The ways take turns; `--rounds` repeats them. The processes run on the first CORES cores, the clients of the
service too. Needs Linux, and the package `molmesh` for the way `python`.
"""

import argparse
import gzip
import io
import json
import os
import random
import re
import resource
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.request
from pathlib import Path
from statistics import median

RESOLUTION = "1"


def residues(path):
    """Returns the lines of the atoms of each residue of a PDB file."""
    data = path.read_bytes()
    text = (gzip.decompress(data) if path.suffix == ".gz" else data).decode("latin-1")
    found = {}
    for line in text.split("\nENDMDL")[0].splitlines():
        if line.startswith("ATOM"):
            found.setdefault(line[21:27], []).append(line)
    return list(found.values())


def write_structures(sources, folder, count, smallest=100):
    """Writes structures of `smallest` residues or more, and returns the total number of residues."""
    generator = random.Random(2010)
    chains = [found for found in map(residues, sources) if len(found) >= smallest]
    total = 0
    for number in range(count):
        chain = generator.choice(chains)
        size = generator.randint(smallest, min(1000, len(chain)))
        first = generator.randint(0, len(chain) - size)
        shift = generator.uniform(0.0, 5.0)
        with open(folder / f"s{number:05}.pdb", "w", encoding="latin-1") as file:
            for line in (line for residue in chain[first : first + size] for line in residue):
                file.write(f"{line[:30]}{float(line[30:38]) + shift:8.3f}{line[38:]}\n")
            file.write("END\n")
        total += size
    return total


def command(binary, folder, out, cores, jobs):
    """Runs `molmesh mesh` on the folder. Returns the peak memory in MB."""
    arguments = [binary, "mesh", f"{folder}/", "-o", f"{out}/", "--surface", "ses", "--resolution", RESOLUTION]
    arguments += ["--areas", "--jobs", str(jobs), "--backend", "cpu", "--quiet", "--summary", f"{out}.jsonl"]
    process = subprocess.Popen(arguments, preexec_fn=lambda: os.sched_setaffinity(0, range(cores)))
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{binary} failed with status {status}")
    return usage.ru_maxrss / 1024


THREADS = """
import pathlib, sys
from concurrent.futures import ThreadPoolExecutor
import molmesh

folder, out, threads = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), int(sys.argv[3])

def work(path):
    structure = molmesh.read(path)
    molmesh.surface(structure, surface="ses", resolution=RESOLUTION, atom_ids=False).save(out / f"{path.stem}.glb")
    return molmesh.areas(structure, surface="ses", by="residue")["area"].sum()

with ThreadPoolExecutor(threads) as pool:
    print(sum(1 for _ in pool.map(work, sorted(folder.iterdir()))))
""".replace("RESOLUTION", RESOLUTION)


def python(folder, out, cores, jobs):
    """Runs threads of one Python process. Returns the peak memory in MB."""
    out.mkdir()
    environment = {**os.environ, "RAYON_NUM_THREADS": str(cores)}
    arguments = [sys.executable, "-c", THREADS, str(folder), str(out), str(jobs)]
    process = subprocess.Popen(arguments, env=environment, preexec_fn=lambda: os.sched_setaffinity(0, range(cores)))
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"Python failed with status {status}")
    return usage.ru_maxrss / 1024


def service(binary, folder, out, cores, size):
    """Sends batches of `size` files to a new service and unpacks the results. Returns its peak memory in MB."""
    out.mkdir()
    with tempfile.TemporaryDirectory() as data:
        arguments = [binary, "serve", "--listen", "127.0.0.1:0", "--backend", "cpu", "--data-dir", data]
        arguments += ["--set", "archive.url=none"]
        pin = lambda: os.sched_setaffinity(0, range(cores))
        log = Path(data, "log")
        with open(log, "wb") as output:
            process = subprocess.Popen(arguments, stderr=output, preexec_fn=pin)
        try:
            while not (found := re.search(r"http://127\.0\.0\.1:\d+", log.read_text())):
                time.sleep(0.01)
            url = found[0]
            files = sorted(folder.iterdir())
            for first in range(0, len(files), size):
                send_batch(url, files[first : first + size], out)
            status = Path(f"/proc/{process.pid}/status").read_text()
            return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1024
        finally:
            process.kill()
            process.wait()


def send_batch(url, files, out):
    """Sends one batch and unpacks its results."""
    body = io.BytesIO()
    with tarfile.open(fileobj=body, mode="w") as tar:
        for path in files:
            tar.add(path, path.name)
    query = f"outputs=glb,areas&surface=ses&resolution={RESOLUTION}"
    request = urllib.request.Request(f"{url}/v1/batches?{query}", body.getvalue(), {"Content-Type": "application/octet-stream"})
    with urllib.request.urlopen(request, timeout=600) as reply:
        location = reply.headers["Location"]
    with urllib.request.urlopen(f"{url}{location}/results.tar", timeout=3600) as reply:
        with tarfile.open(fileobj=reply, mode="r|") as tar:
            tar.extractall(out, filter="data")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("binary", type=Path)
    parser.add_argument("sources", type=Path, nargs="+")
    parser.add_argument("--files", type=int, default=2000)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--batch", type=int, default=500, help="number of files of a batch of the service")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--ways", default="command,python,service")
    arguments = parser.parse_args()
    binary = str(arguments.binary.resolve())
    resource.setrlimit(resource.RLIMIT_NOFILE, (4096, 4096))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, "structures")
        folder.mkdir()
        total = write_structures(arguments.sources, folder, arguments.files)
        print(f"{arguments.files} structures, {total} residues, {arguments.cores} cores")
        results = {way: [] for way in arguments.ways.split(",")}
        for round_ in range(arguments.rounds):
            for way, found in results.items():
                out = Path(temporary, f"{way}-{round_}")
                begin = time.perf_counter()
                if way == "command":
                    memory = command(binary, folder, out, arguments.cores, arguments.jobs)
                elif way == "python":
                    memory = python(folder, out, arguments.cores, arguments.jobs)
                else:
                    memory = service(binary, folder, out, arguments.cores, arguments.batch)
                seconds = time.perf_counter() - begin
                written = sum(1 for path in out.rglob("*.glb"))
                if written != arguments.files:
                    raise SystemExit(f"{way}: {written} of {arguments.files} meshes")
                found.append((seconds, memory))
                subprocess.run(["rm", "-rf", str(out)], check=True)
        for way, found in results.items():
            seconds = median(seconds for seconds, _ in found)
            rate = round(arguments.files / seconds * 3600)
            memory = max(memory for _, memory in found)
            print(json.dumps({"way": way, "seconds": round(seconds, 1), "files_per_hour": rate, "memory_mb": round(memory)}))


if __name__ == "__main__":
    main()
