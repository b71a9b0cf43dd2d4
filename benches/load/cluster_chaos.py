#!/usr/bin/env python3
"""Checks that a cluster loses no accepted job, however its processes are killed.

    python3 benches/load/cluster_chaos.py target/release/molmesh NATS-SERVER samples/4pti.pdb --kills 200

Two nodes that answer requests, two workers and a NATS server share one folder. Clients submit asynchronous jobs to both
nodes without a pause. A random process is killed (`kill -9`) and started again after a random pause; of the kills of
NATS, every second one also removes its data. Finally the script waits for all jobs, compares every result with the
output of `molmesh mesh` on both nodes, and checks that every stored file is complete. The exit code is 1 if a job is
lost, a result is wrong, or no job was open at most of the kills.
"""

import argparse
import collections
import os
import random
import shutil
import sys
import time

from chaos import FINISH_TIMEOUT, Clients, outcome
from cluster import Cluster
from mixed import Expected


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("nats")
    parser.add_argument("structures", nargs="+")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32))
    parser.add_argument("--clients", type=int, default=4, help="clients of each node")
    parser.add_argument("--port", type=int, default=18600)
    args = parser.parse_args()
    print(f"seed {args.seed}", flush=True)
    dice = random.Random(args.seed)
    expected = Expected(args.binary, args.structures)
    # A job may be started at every kill, so attempts are not limited. No record of an ended job is removed.
    cluster = Cluster(
        args.binary, args.nats, args.port, ["api", "api", "worker", "worker"],
        ["broker.lease_ms=2000", "jobs.attempts=100000", "jobs.records_per_client=100000"],
    )
    cluster.start()
    apis = enumerate(cluster.of_role("api"))
    clients = [Clients(node.port, expected, args.seed + n, args.clients) for n, node in apis]
    killed, with_jobs = collections.Counter(), 0
    for number in range(args.kills):
        time.sleep(dice.uniform(0.1, 0.6))
        with_jobs += cluster.open_jobs() > 0
        if dice.random() < 0.25:
            cluster.nats.kill()
            if number % 2:
                shutil.rmtree(cluster.nats.command[-1], ignore_errors=True)
            time.sleep(dice.uniform(0, 0.5))
            cluster.nats.launch()
            killed["nats"] += 1
            continue
        node = dice.choice(cluster.nodes)
        node.process.kill()
        node.process.wait()
        time.sleep(dice.uniform(0, 0.5))
        node.launch()
        killed[node.role] += 1
    for client in clients:
        client.finish()
    cluster.ready()
    deadline = time.monotonic() + FINISH_TIMEOUT
    jobs = [job for client in clients for job in client.jobs.items()]
    ports = [node.port for node in cluster.of_role("api")]
    ends = collections.Counter(outcome(dice.choice(ports), job, mesh, deadline) for job, mesh in jobs)
    whole = set(expected.files.values())
    results = os.path.join(cluster.store, "results")
    for name in os.listdir(results):
        if name.endswith(".glb"):
            with open(os.path.join(results, name), "rb") as file:
                if file.read() not in whole:
                    ends["bad: a half-written result"] += 1
    cluster.stop()
    print(f"{args.kills} kills: {dict(killed)}; jobs were open at {with_jobs} of them")
    print(f"{len(jobs)} accepted jobs: {dict(ends)}")
    if any(end.startswith("bad") for end in ends) or not ends["successful"] or with_jobs <= args.kills // 2:
        sys.exit(f"errors occurred with seed {args.seed}: see above")


if __name__ == "__main__":
    main()
