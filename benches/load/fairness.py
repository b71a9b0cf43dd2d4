#!/usr/bin/env python3
"""Measures the latency of a small mesh and a small document while other clients send heavy work.

Prints p50 and p99 of new meshes of 4PTI and of its list of atoms, one after another, alone, beside two asynchronous
jobs, beside the three heaviest requests (a mesh and two documents), and beside both. Each client has its own loopback
address, so Linux only.
"""

import argparse
import gzip
import itertools
import statistics
import tempfile
import threading
import time
import urllib.parse

import mixed
from mixed import UNAVAILABLE, Server

SMALL, BATCH, HEAVY = "127.0.0.2", "127.0.0.3", "127.0.0.4"
PORT = 18400
REPORT = "pockets=true&pocket_probe=5&resolution=3"


def fetch(client, method, path, body=None, headers=None):
    """Sends a request from the address of a client. Returns status, headers and body."""
    return mixed.fetch(PORT, method, path, body, headers, timeout=600, client=client)


def lattice(side):
    """Returns a compressed XYZ file of `side`³ atoms, 4 Å apart."""
    lines = (f"C {4 * x} {4 * y} {4 * z}" for x, y, z in itertools.product(range(side), repeat=3))
    return gzip.compress(f"{side**3}\nlattice\n{chr(10).join(lines)}\n".encode(), 6)


class Load:
    """Clients that repeat their requests until the load ends."""

    def __init__(self, requests):
        self.stopped, self.ended = threading.Event(), 0
        self.threads = [threading.Thread(target=self.repeat, args=(request,), daemon=True) for request in requests]
        for thread in self.threads:
            thread.start()

    def repeat(self, request):
        while not self.stopped.is_set():
            try:
                request(self.stopped)
                self.ended += 1
            except UNAVAILABLE:
                pass

    def stop(self):
        self.stopped.set()


def batch(body):
    """Returns a request for an asynchronous job, which ends with the job."""

    def run(stopped):
        _, headers, _ = fetch(BATCH, "POST", f"/v1/report?{REPORT}", body, {"prefer": "respond-async"})
        job = headers["location"]
        while not stopped.is_set() and b'"finished":null' in fetch(BATCH, "GET", f"{job}?wait=1")[2]:
            pass
        if stopped.is_set():
            fetch(BATCH, "DELETE", job)

    return run


def timed(times, *request):
    """Sends a request of the small client, and adds its time in ms to a list."""
    begin = time.perf_counter()
    status, _, text = fetch(SMALL, *request)
    times.append(1e3 * (time.perf_counter() - begin))
    if status != 200:
        print(f"status {status}: {text[:200]}")


def small_requests(sample, seconds):
    """Sends new small meshes and small documents for some seconds. Returns the times of both in ms."""
    meshes, documents, end = [], [], time.perf_counter() + seconds
    atoms = fetch(SMALL, "POST", "/v1/structures", sample)[1]["location"] + "/atoms?positions=true"
    while time.perf_counter() < end:
        timed(meshes, "POST", "/v1/meshes?resolution=1", f"REMARK 900 {time.time_ns()}\n".encode() + sample)
        timed(documents, "GET", atoms)
        time.sleep(0.02)
    return meshes, documents


def figures(times):
    """Returns p50, p99 and the maximum as columns."""
    times = sorted(times)
    p99 = times[min(len(times) - 1, len(times) * 99 // 100)]
    return f"{statistics.median(times):>7.1f} {p99:>7.1f} {times[-1]:>7.1f}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("binary")
    parser.add_argument("sample")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--side", type=int, default=100, help="atoms along an edge of the lattice")
    args = parser.parse_args()
    with open(args.sample, "rb") as file:
        sample = file.read()
    body = lattice(args.side)
    with tempfile.TemporaryDirectory() as folder:
        server = Server(args.binary, folder, PORT, ["--devices", "cpu"])
        server.start()
        structure = fetch(HEAVY, "POST", "/v1/structures", body)[1]["location"]
        select = "all"
        for _ in range(8):
            select = f"within 50 of ({select})"
        heavy = [
            f"{structure}/report.json?{REPORT}",
            f"{structure}/atoms?positions=true&select={urllib.parse.quote(select)}",
            f"{structure}/areas?surface=sas",
        ]

        def get(path):
            return lambda _stopped: fetch(HEAVY, "GET", path)

        # Different files, so that the two jobs do not share their work.
        jobs = [batch(body), batch(lattice(args.side - 1))]
        requests = [get(path) for path in heavy]
        print(f"{'times in ms':<24} {'mesh: p50, p99, max':>23}   {'document: p50, p99, max':>23}")
        small_requests(sample, 3)
        for name, load in (("nothing", []), ("two jobs", jobs), ("three requests", requests), ("both", jobs + requests)):
            running = Load(load)
            time.sleep(3 if load else 0)
            meshes, documents = small_requests(sample, args.seconds)
            running.stop()
            print(f"{name:<24} {figures(meshes)}   {figures(documents)}", flush=True)
            if load:
                # The requests of this load end before the next one.
                server.stop()
                server.start()
        server.stop()


if __name__ == "__main__":
    main()
