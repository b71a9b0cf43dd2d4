#!/usr/bin/env python3
"""Checks that accepted jobs survive kills and stops at random points.

    python3 benches/load/chaos.py target/release/molmesh samples/4pti.pdb --kills 200

Clients submit asynchronous jobs without a pause. The service is killed (`kill -9`) while it serves, while it recovers
the jobs of the process before, and while it drains after SIGTERM. A third of the restarts follow an orderly stop
instead: SIGTERM with a drain timeout that is too short for most jobs, sometimes cut by a second SIGTERM. After it,
every open job must have the number of attempts that it had before the process started.

All limits of jobs have their defaults, so a job that is started three times and killed each time fails; any other end
without a result is an error. Finally the script waits for all jobs and compares every result with the output of
`molmesh mesh`. The exit code is 1 if a job is lost, a result is wrong, a stop counts an attempt, or no job was open at
most of the kills and stops, because such a run tests nothing.

    python3 benches/load/chaos.py target/release/molmesh samples/4pti.pdb --kills 20 --job-seconds 30

With `--job-seconds`, one job at a time that takes about this long alone is stopped at a random point, again and again
until it ends within a drain of `--drain-ms`. The script prints a row for each stop: no stop may count an attempt. The
last row is the control, a kill (`kill -9`), which counts one. The exit code is 1 if a stop counted an attempt or was
not orderly, the kill did not count one, or a job did not end with the right mesh.

    python3 benches/load/chaos.py target/release/molmesh samples/4pti.pdb --kills 200 --batch 500

With `--batch`, clients post one batch of this many small structures until it is accepted, and then read its results
again and again. The service is killed while it accepts the batch, recovers, works and sends results. Kills wait for
files to end, so that the batch outlasts them. The final archive of results must have each mesh of `molmesh mesh`
exactly once, and must begin with every response that a kill cut off. Only a file whose last attempt was killed may be
missing; it counts as abandoned. The exit code is 1 if the batch or a file is lost, a result is wrong or duplicated, the
service does not stop in order, or the run tests nothing: the batch was not open at most of the kills, no response was
cut off, or half of the files failed.
"""

import argparse
import collections
import http.client
import io
import json
import os
import random
import re
import signal
import subprocess
import sys
import tarfile
import threading
import time
from pathlib import Path

from batches import write_structures
from mixed import UNAVAILABLE, Expected, Server, fetch, folder

OPEN = ("accepted", "running")
# Longest drain, ms. The kills of this phase come within it.
DRAIN_MS = 300
# Time for all remaining jobs to end, s.
FINISH_TIMEOUT = 300
# Default of `jobs.attempts`.
ATTEMPTS = 3
# Parameters of a batch. Its results are small, because they are sent again after every kill.
BATCH = {"resolution": "0.6", "surface": "ses", "compress": "meshopt"}


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
            try:
                self.request(dice)
            except UNAVAILABLE:
                pass
            time.sleep(0.02)

    def request(self, dice):
        structure, query, mesh = self.expected.next_request(dice)
        status, headers, _ = fetch(self.port, "POST", f"/v1/meshes?{query}", structure, {"prefer": "respond-async"}, 10)
        if status == 202:
            self.jobs[headers["location"]] = mesh

    def finish(self):
        self.over.set()
        for thread in self.threads:
            thread.join()


def open_jobs(data):
    """Returns status and number of attempts of each job on disk that has not ended, by id."""
    folder, jobs = os.path.join(data, "store", "jobs"), {}
    names = set(os.listdir(folder) if os.path.isdir(folder) else [])
    for name in names:
        job, _, extension = name.partition(".")
        # Temporary files of writes that the kill interrupted are incomplete. A crash may leave both records of a job.
        if extension == "json" and f"{job}.ended.json" not in names:
            with open(os.path.join(folder, name), "rb") as file:
                record = json.load(file)
            if record["status"] in OPEN:
                jobs[job] = record["status"], record["attempts"]
    return jobs


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
        time.sleep(dice.uniform(0, DRAIN_MS / 1000))
    server.process.kill()
    server.process.wait()


def stop(server, before, dice):
    """Starts the service and stops it at a random point. `before` has the open jobs of the time before. Returns the
    errors."""
    server.start()
    time.sleep(dice.uniform(0.05, 0.4))
    server.process.terminate()
    if dice.random() < 0.3:
        time.sleep(dice.uniform(0, DRAIN_MS / 1000))
        server.process.terminate()
    code = server.process.wait()
    # A short drain may cut off a request of a client, which sends it again.
    errors = [] if code in (0, 1) else [f"bad: the service stopped with {code}"]
    for job, found in open_jobs(server.folder).items():
        # A job that the process did not claim is as the last kill left it.
        earlier = before.get(job, ("accepted", 0))
        if found not in (earlier, ("accepted", earlier[1])):
            errors.append(f"bad: {earlier} before a stop, {found} after it")
    return errors


def is_abandoned(problem):
    """Returns true for the problem of a job without attempts left. A job that lost its input has the same type."""
    return bool(problem) and (problem["type"], problem.get("actual")) == ("/problems/job-abandoned", ATTEMPTS)


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
        return "abandoned" if is_abandoned(document.get("problem")) else f"bad: {document}"
    status, headers, _ = fetch(port, "GET", f"{job}/result")
    status, _, body = fetch(port, "GET", headers["location"]) if status == 303 else (status, None, None)
    return "successful" if (status, body) == (200, mesh) else f"bad: result with status {status}"


def long_mesh(binary, structure, seconds):
    """Finds a mesh that takes about `seconds`. Returns its parameters, and its bytes by `molmesh mesh`."""
    resolution = 0.2
    while True:
        parameters = {"quality": "high", "format": "ply-text", "resolution": f"{resolution:.3g}"}
        options = [part for name, value in parameters.items() for part in (f"--{name}", value)]
        command, begin = [binary, "mesh", structure, "-o", "-", "--backend", "cpu", *options], time.perf_counter()
        mesh = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, check=True).stdout
        took = time.perf_counter() - begin
        if took > 0.8 * seconds:
            return "&".join(f"{name}={value}" for name, value in parameters.items()), mesh
        # The time is about inversely proportional to the square of the grid spacing.
        resolution *= max(took / seconds, 0.05) ** 0.5


def record(data, job):
    """Returns the record of a job on disk."""
    name = os.path.join(data, "store", "jobs", job.rpartition("/")[2])
    ended = f"{name}.ended.json"
    with open(ended if os.path.exists(ended) else f"{name}.json", "rb") as file:
        return json.load(file)


class LongJob:
    """One job at a time, with a service that is stopped while it runs."""

    def __init__(self, server, structure, query):
        self.server, self.structure, self.query, self.jobs = server, structure, query, []

    def ensure(self):
        """Starts the service. It continues the last job; if that one has ended, the next job begins. Returns the number
        of attempts that the job had before."""
        last = record(self.server.folder, self.jobs[-1]) if self.jobs else {"status": "none"}
        self.server.start()
        if last["status"] in OPEN:
            return last["attempts"]
        body = self.structure + b"REMARK 900 %032x\n" % random.getrandbits(128)
        path = f"/v1/meshes?{self.query}"
        status, headers, text = fetch(self.server.port, "POST", path, body, {"prefer": "respond-async"})
        if status != 202:
            sys.exit(f"status {status}: {text[:200]}")
        self.jobs.append(headers["location"])
        return 0

    def interrupt(self, seconds, end):
        """Runs the job for some seconds and ends the service. Prints the row. Returns the number of attempts that were
        counted, and true if the end was orderly."""
        before = self.ensure()
        time.sleep(seconds)
        stage = json.loads(fetch(self.server.port, "GET", self.jobs[-1])[2])["stage"]
        code, took = end()
        with open(self.server.log, encoding="utf-8", errors="replace") as log:
            lines = [line for line in log if "jobs_returned" in line] if code >= 0 else []
        counts = ", ".join(f"{n} {what}" for what, n in re.findall(r"jobs_(\w+)=(\d+)", lines[-1])) if lines else "-"
        found = record(self.server.folder, self.jobs[-1])
        # The attempt that made the mesh counts.
        counted = found["attempts"] - before - (found["status"] == "successful")
        print(
            f"{len(self.jobs):>3} {seconds:>8.1f} {stage or '-':<12} {took:>8.1f} {code:>4} {counts:<36}"
            f" {counted:>8} {found['status']}",
            flush=True,
        )
        return counted, code == 0

    def kill(self):
        begin = time.perf_counter()
        self.server.process.kill()
        return self.server.process.wait(), time.perf_counter() - begin


def stop_long_jobs(args, dice):
    """Stops long jobs at random points, and prints a table."""
    query, mesh = long_mesh(args.binary, args.structures[0], args.job_seconds)
    drain = ["--set", "server.termination_notice_ms=none", "--set", f"server.drain_timeout_ms={args.drain_ms}"]
    server = Server(args.binary, folder(), args.port, ["--backend", "cpu", *drain])
    with open(args.structures[0], "rb") as file:
        long = LongJob(server, file.read(), query)
    long.ensure()
    begin = time.perf_counter()
    ends = [outcome(args.port, long.jobs[0], mesh, time.monotonic() + FINISH_TIMEOUT)]
    alone = time.perf_counter() - begin
    server.stop()
    print(f"{query}: {alone:.1f} s alone, {ends[0]}; drain of {args.drain_ms} ms")
    print(f"job after, s {'stage':<12} took, s code {'jobs by the log':<36} attempts status")
    stops = [long.interrupt(dice.uniform(0, alone), server.stop) for _ in range(args.kills)]
    counted, _ = long.interrupt(dice.uniform(0.2, 0.8) * alone, long.kill)
    server.start()
    deadline = time.monotonic() + FINISH_TIMEOUT
    ends += [outcome(args.port, job, mesh, deadline) for job in long.jobs[1:]]
    server.stop()
    attempts, orderly = sum(attempts for attempts, _ in stops), sum(orderly for _, orderly in stops)
    print(f"{len(stops)} stops, {orderly} of them orderly: {attempts} attempts counted; a kill: {counted}")
    print(f"{len(long.jobs)} accepted jobs: {dict(collections.Counter(ends))}")
    if attempts or orderly < len(stops) or counted != 1 or set(ends) != {"successful"}:
        sys.exit(f"errors occurred with seed {args.seed}: see above")


class BatchClients(Clients):
    """Threads that post one batch until it is accepted, and then read its results."""

    def __init__(self, port, archive, number):
        self.location, self.results, self.cut, self.errors = None, b"", 0, []
        super().__init__(port, archive, 0, number)

    def request(self, _dice):
        self.compare(self.read() if self.location else self.post())

    def post(self):
        """Posts the batch. If it was accepted before, the response must name the same one."""
        query, key = "&".join(map("=".join, BATCH.items())), {"idempotency-key": "chaos"}
        status, headers, _ = fetch(self.port, "POST", f"/v1/batches?{query}", self.expected, key, FINISH_TIMEOUT)
        location = headers["location"]
        self.location = self.location or location
        if status not in (202, 503) or location not in (None, self.location):
            self.errors.append(f"bad: status {status} for the batch {location}")
        return b""

    def read(self, part="/results.tar"):
        """Reads a part of the batch, as far as the service sends it."""
        try:
            status, _, body = fetch(self.port, "GET", self.location + part, timeout=FINISH_TIMEOUT)
        except http.client.IncompleteRead as error:
            self.cut += len(error.partial) > 0
            return error.partial
        self.errors += [] if status in (200, 503) else [f"bad: status {status} for {part}"]
        return body if status == 200 else b""

    def compare(self, results):
        """Compares the beginnings of two archives, and keeps the longer one."""
        short, self.results = sorted((results, self.results), key=len)
        self.errors += [] if self.results.startswith(short) else ["bad: results that differ"]


def write_batch(args):
    """Returns an archive of small structures, and their meshes by name in the results."""
    inputs, meshes, archive = folder(), folder(), io.BytesIO()
    write_structures(map(Path, args.structures), Path(inputs), args.batch, 20)
    with tarfile.open(fileobj=archive, mode="w") as tar:
        for path in Path(inputs).iterdir():
            tar.add(path, path.name)
    options = [part for name, value in BATCH.items() for part in (f"--{name}", value)]
    command = [args.binary, "mesh", f"{inputs}/", "-o", f"{meshes}/", "--backend", "cpu", "--quiet", *options]
    subprocess.run(command, check=True)
    return archive.getvalue(), {path.name: path.read_bytes() for path in Path(meshes).iterdir()}


def file_outcomes(archive, meshes):
    """Counts the outcomes of the files of a batch."""
    copies = collections.defaultdict(list)
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        for entry in tar:
            copies[entry.name].append(tar.extractfile(entry).read())
    lines = [json.loads(line) for line in b"".join(copies.pop("summary.jsonl")).splitlines()]
    ends = collections.Counter()
    for line in lines:
        name, problem = line["input"].replace(".pdb", ".glb"), line.get("problem")
        found = copies.pop(name, [])
        if found == [meshes.get(name)] and problem is None:
            ends["successful"] += 1
        else:
            bad = f"bad: right results {[mesh == meshes.get(name) for mesh in found]}, {problem}"
            ends["abandoned" if not found and is_abandoned(problem) else bad] += 1
    ends["bad: results or lines without the other"] = len(copies) + abs(len(lines) - len(meshes))
    return ends


def kill_batch(args, server, dice):
    """Kills the service at random points of a batch."""
    archive, meshes = write_batch(args)
    if len(set(meshes.values())) != args.batch:
        sys.exit("two structures have the same mesh")
    ended_jobs = lambda: len(list(Path(server.folder, "store/jobs").glob("*.ended.json")))
    clients = BatchClients(args.port, archive, args.clients)
    phases, with_batch, last_attempts, ready = collections.Counter(), 0, set(), 0.1
    for left in range(args.kills, 0, -1):
        phase = dice.choice(["work", "work", "recovery"]) if clients.location else "acceptance"
        ended, deadline = ended_jobs(), time.monotonic() + FINISH_TIMEOUT
        if phase == "recovery":
            server.launch()
        else:
            ready = server.start()
        # About the remaining files divided by the remaining kills.
        goal = min(ended + dice.randint(0, 2 * (args.batch - ended) // left), args.batch - 1)
        while phase == "work" and ended_jobs() < goal and time.monotonic() < deadline:
            time.sleep(0.005)
        # Kills come later and later until one comes after the acceptance.
        latest = {"acceptance": 0.04 * args.batch * (1 - left / args.kills), "recovery": ready, "work": 0.05}[phase]
        time.sleep(dice.uniform(0, latest))
        server.process.kill()
        is_killed = server.process.wait() == -signal.SIGKILL and time.monotonic() < deadline
        clients.errors += [] if is_killed else ["bad: the service ended by itself, or made no progress"]
        phases[phase] += 1
        jobs = open_jobs(server.folder)
        with_batch += not clients.location or len(jobs) > 0
        last_attempts |= {job for job, found in jobs.items() if found == ("running", ATTEMPTS)}
    clients.finish()
    server.start()
    clients.post()
    results, counts = clients.read(), json.loads(clients.read(""))["counts"]
    clients.errors += [] if results.startswith(clients.results) else ["bad: results that differ"]
    code, _ = server.stop()
    ends = file_outcomes(results, meshes) + collections.Counter(clients.errors)
    print(f"{args.kills} kills: {dict(phases)}; the batch was open or not yet accepted at {with_batch} of them")
    print(f"{args.batch} files: {dict(ends)}; state {counts}; {clients.cut} responses were cut off")
    print(f"the last attempts of {len(last_attempts)} jobs were killed; the service stopped with {code}")
    bad = [end for end in ends if end.startswith("bad")] or code or ends["abandoned"] > len(last_attempts)
    is_test = clients.cut and ends["successful"] > args.batch // 2 and with_batch > args.kills // 2
    if not is_test:
        print("bad: too few kills during the batch, responses that were cut off, or successful files: this tests nothing")
    if bad or not is_test or counts["successful"] != ends["successful"]:
        sys.exit(f"errors occurred with seed {args.seed}: see above")


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("structures", nargs="+")
    parser.add_argument("--kills", type=int, default=200, help="number of kills and stops")
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32))
    parser.add_argument("--clients", type=int, default=3)
    parser.add_argument("--port", type=int, default=18500)
    parser.add_argument("--job-seconds", type=float, help="stop one job that takes this long alone")
    parser.add_argument("--batch", type=int, help="kill the service during one batch of this many files")
    parser.add_argument("--drain-ms", type=int, default=2000, help="drain with --job-seconds")
    args = parser.parse_args()
    print(f"seed {args.seed}", flush=True)
    dice, data = random.Random(args.seed), folder()
    if args.job_seconds:
        return stop_long_jobs(args, dice)
    server = Server(args.binary, data, args.port, ["--backend", "cpu", "--set", "server.termination_notice_ms=none"])
    if args.batch:
        return kill_batch(args, server, dice)
    command = server.command
    clients = Clients(args.port, Expected(args.binary, args.structures), args.seed, args.clients)
    phases, with_jobs, jobs, errors = collections.Counter(), 0, {}, []
    for _ in range(args.kills):
        phase = dice.choice(["load", "load", "recovery", "drain", "stop", "stop"])
        drain_ms = dice.randrange(DRAIN_MS) if phase == "stop" else DRAIN_MS
        server.command = [*command, "--set", f"server.drain_timeout_ms={drain_ms}"]
        if phase == "stop":
            errors += stop(server, jobs, dice)
        else:
            kill(server, phase, dice)
        phases[phase] += 1
        jobs = open_jobs(data)
        with_jobs += len(jobs) > 0
    clients.finish()
    server.command = command
    server.start()
    deadline = time.monotonic() + FINISH_TIMEOUT
    ends = collections.Counter(outcome(args.port, job, mesh, deadline) for job, mesh in clients.jobs.items())
    code, _ = server.stop()
    with open(server.log, encoding="utf-8", errors="replace") as log:
        errors += [f"bad: {line.strip()}" for line in log if "could not be recorded in time" in line]
    print(f"{args.kills} kills and stops: {dict(phases)}; jobs were open at {with_jobs} of them")
    print(f"{len(clients.jobs)} accepted jobs: {dict(ends)}; the service stopped with {code}")
    print("\n".join(errors), end="\n" if errors else "")
    bad = errors + [end for end in ends if end.startswith("bad")]
    if bad or code or not ends["successful"] or with_jobs <= args.kills // 2:
        sys.exit(f"errors occurred with seed {args.seed}: see above")


if __name__ == "__main__":
    main()
