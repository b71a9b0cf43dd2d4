#!/usr/bin/env python3
"""Checks that accepted jobs survive kills at random points.

    python3 benches/load/chaos.py target/release/molmesh samples/4pti.pdb --kills 200

Clients submit asynchronous jobs without a pause. The service is killed (`kill -9`) while it serves, while it recovers
the jobs of the process before, and while it drains after SIGTERM. All limits have their defaults, so a job that is
started three times and killed each time fails; any other end without a result is an error. Finally the script waits for
all jobs and compares every result with the output of `molmesh mesh`. The exit code is 1 if a job is lost, a result is
wrong, or no job was open at most of the kills, because such a run tests nothing.
"""

import argparse
import collections
import json
import os
import random
import sys
import threading
import time

from mixed import UNAVAILABLE, Expected, Server, fetch, folder

OPEN = ("accepted", "running")
# Time for all remaining jobs to end, s.
FINISH_TIMEOUT = 300


class Clients:
    """Threads that submit jobs. `jobs` has the address and the expected bytes of each accepted job."""

    def __init__(self, port, expected, seed, number):
        self.port, self.expected, self.jobs = port, expected, {}
        self.over, self.threads = threading.Event(), []
        for n in range(number):
            self.threads.append(threading.Thread(target=self.submit, args=(random.Random(seed + n),)))
            self.threads[-1].start()

    def submit(self, dice):
        while not self.over.is_set():
            structure, query, mesh = self.expected.next_request(dice)
            try:
                status, headers, _ = fetch(self.port, "POST", f"/v1/meshes?{query}", structure, {"prefer": "respond-async"}, 10)
                if status == 202:
                    self.jobs[headers["location"]] = mesh
            except UNAVAILABLE:
                pass
            time.sleep(0.02)

    def finish(self):
        self.over.set()
        for thread in self.threads:
            thread.join()


def open_jobs(data):
    """Returns the number of records on disk whose jobs have not ended."""
    jobs, number = os.path.join(data, "store", "jobs"), 0
    for name in os.listdir(jobs) if os.path.isdir(jobs) else []:
        with open(os.path.join(jobs, name), "rb") as file:
            text = file.read()
        # Temporary files of writes that the kill interrupted are incomplete.
        number += name.endswith(".json") and json.loads(text)["status"] in OPEN
    return number


def kill(server, phase, dice):
    """Starts the service and kills it at a random point of a phase."""
    if phase == "recovery":
        server.launch()
        time.sleep(dice.uniform(0, 0.3))
    else:
        server.start()
        time.sleep(dice.uniform(0.05, 0.4))
    if phase == "drain":
        server.process.terminate()
        time.sleep(dice.uniform(0, 0.3))
    server.process.kill()
    server.process.wait()


def outcome(port, job, mesh, deadline):
    """Waits for a job. Returns `successful`, `abandoned`, or an error that begins with `bad`."""
    status, document = None, {"status": "accepted"}
    while document["status"] in OPEN:
        if time.monotonic() > deadline:
            return "bad: does not end"
        status, _, body = fetch(port, "GET", f"{job}?wait=20")
        if status != 200:
            return f"bad: status {status}"
        document = json.loads(body)
    if document["status"] != "successful":
        problem = document.get("problem") or {}
        return "abandoned" if problem.get("type") == "/problems/job-abandoned" else f"bad: {document}"
    status, headers, _ = fetch(port, "GET", f"{job}/result")
    status, _, body = fetch(port, "GET", headers["location"]) if status == 303 else (status, None, None)
    return "successful" if (status, body) == (200, mesh) else f"bad: result with status {status}"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("structures", nargs="+")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32))
    parser.add_argument("--clients", type=int, default=3)
    parser.add_argument("--port", type=int, default=18500)
    args = parser.parse_args()
    print(f"seed {args.seed}", flush=True)
    dice, data = random.Random(args.seed), folder()
    server = Server(args.binary, data, args.port, ["--backend", "cpu"])
    clients = Clients(args.port, Expected(args.binary, args.structures), args.seed, args.clients)
    phases, with_jobs = collections.Counter(), 0
    for _ in range(args.kills):
        phase = dice.choice(["load", "load", "recovery", "drain"])
        kill(server, phase, dice)
        phases[phase] += 1
        with_jobs += open_jobs(data) > 0
    clients.finish()
    server.start()
    deadline = time.monotonic() + FINISH_TIMEOUT
    ends = collections.Counter(outcome(args.port, job, mesh, deadline) for job, mesh in clients.jobs.items())
    code, _ = server.stop()
    print(f"{args.kills} kills: {dict(phases)}; jobs were open at {with_jobs} of them")
    print(f"{len(clients.jobs)} accepted jobs: {dict(ends)}; the service stopped with {code}")
    bad = [end for end in ends if end.startswith("bad")]
    if bad or code or not ends["successful"] or with_jobs <= args.kills // 2:
        sys.exit(f"errors occurred with seed {args.seed}: see above")


if __name__ == "__main__":
    main()
