#!/usr/bin/env python3
"""Checks that a cluster loses no accepted job when its network is divided, or when queue or store are away.

    python3 benches/load/cluster_partitions.py target/release/molmesh NATS-SERVER samples/4pti.pdb --partitions 20

Each worker runs in a network namespace of its own (needs root), connected by a pair of virtual interfaces. While
clients submit jobs, the interface of a random worker goes down for a random time, longer or shorter than the lease.
Then NATS is stopped for 30 s (SIGSTOP), and the folder of the store is moved away for 30 s. The script reports the
times until jobs are rejected and accepted again, and finally waits for all jobs and compares their results.
"""

import argparse
import collections
import os
import random
import signal
import subprocess
import sys
import time

from chaos import FINISH_TIMEOUT, Clients, outcome
from cluster import Cluster
from mixed import Expected, fetch

LEASE = 2.0
NETWORK = "10.213.{}.{}"


def run(*command, check=True):
    subprocess.run(command, check=check, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


class Network:
    """Network namespaces of the workers."""

    def __init__(self, number):
        self.names = [f"mmw{n}" for n in range(number)]
        for n, name in enumerate(self.names):
            host, inside = NETWORK.format(n, 1), NETWORK.format(n, 2)
            # Remains of an interrupted run.
            run("ip", "link", "del", f"{name}h", check=False)
            run("ip", "netns", "del", name, check=False)
            run("ip", "netns", "add", name)
            run("ip", "link", "add", f"{name}h", "type", "veth", "peer", "name", f"{name}i", "netns", name)
            run("ip", "addr", "add", f"{host}/24", "dev", f"{name}h")
            run("ip", "link", "set", f"{name}h", "up")
            for command in (["addr", "add", f"{inside}/24", "dev", f"{name}i"], ["link", "set", f"{name}i", "up"]):
                run("ip", "-n", name, *command)
            run("ip", "-n", name, "link", "set", "lo", "up")

    def divide(self, name, divided):
        run("ip", "link", "set", f"{name}h", "down" if divided else "up")

    def remove(self):
        for name in self.names:
            run("ip", "netns", "del", name, check=False)


def status_of_job(port, structure):
    """Returns the status of a request for a job, and its `Retry-After`."""
    # A result that is stored needs no worker.
    fresh = structure + b"REMARK 900 %032x\n" % random.getrandbits(128)
    status, headers, _ = fetch(port, "POST", "/v1/meshes?resolution=2", fresh, {"prefer": "respond-async"}, 40)
    return status, headers.get("retry-after")


def away(what, port, structure, key, begin, end, seconds=30):
    """Takes something away for some seconds. Reports the times until jobs are rejected and accepted."""
    begin()
    begun, rejected, cached, retry = time.monotonic(), None, set(), None
    while time.monotonic() < begun + seconds:
        status, after = status_of_job(port, structure)
        if status == 503 and rejected is None:
            rejected, retry = time.monotonic() - begun, after
        cached.add(fetch(port, "GET", key)[0])
        time.sleep(0.2)
    end()
    ended = time.monotonic()
    while status_of_job(port, structure)[0] != 202:
        time.sleep(0.05)
    recovered = time.monotonic() - ended
    after = "never" if rejected is None else f"after {rejected:.2f} s (Retry-After {retry})"
    print(f"{what} away for {seconds} s: jobs rejected {after}, stored results {cached},", end=" ")
    print(f"jobs accepted {recovered:.2f} s after its return", flush=True)
    # Results of a store that is away are not missing.
    return rejected is not None and recovered <= 5 and 404 not in cached


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("nats")
    parser.add_argument("structures", nargs="+")
    parser.add_argument("--partitions", type=int, default=20)
    parser.add_argument("--seed", type=int, default=random.randrange(1 << 32))
    parser.add_argument("--port", type=int, default=18700)
    args = parser.parse_args()
    print(f"seed {args.seed}", flush=True)
    dice, expected = random.Random(args.seed), Expected(args.binary, args.structures)
    settings = ["jobs.attempts=100000", "jobs.records_per_client=100000", f"broker.lease_ms={LEASE * 1e3:.0f}"]
    settings.append("store.timeout_ms=2000")
    cluster = Cluster(args.binary, args.nats, args.port, ["api", "worker", "worker"], settings)
    cluster.nats.command[cluster.nats.command.index("127.0.0.1")] = "0.0.0.0"
    network = Network(2)
    try:
        for n, node in enumerate(cluster.of_role("worker")):
            # From its namespace a worker reaches NATS at the other end of its interface.
            node.command = ["ip", "netns", "exec", network.names[n], *node.command]
            node.command = [part.replace("nats://127.0.0.1", f"nats://{NETWORK.format(n, 1)}") for part in node.command]
        cluster.nats.launch()
        for node in cluster.nodes:
            node.launch()
        good = attack(cluster, network, expected, dice, args)
    finally:
        for node in cluster.nodes:
            node.process.kill()
        cluster.nats.kill()
        network.remove()
    if not good:
        sys.exit(f"errors occurred with seed {args.seed}: see above")


def attack(cluster, network, expected, dice, args):
    """Divides the network and takes queue and store away. Returns true if nothing was lost."""
    port = cluster.of_role("api")[0].port
    structure = expected.inputs[0][0]
    for _ in range(300):
        try:
            if fetch(port, "GET", "/readyz")[0] == 200:
                break
        except OSError:
            pass
        time.sleep(0.1)
    status, _, _ = fetch(port, "POST", "/v1/meshes?resolution=2", structure)
    key = fetch(port, "POST", "/v1/meshes?resolution=2", structure)[1]["content-location"]
    clients = Clients(port, expected, args.seed, 2)
    good = status == 200
    for _ in range(args.partitions):
        name = dice.choice(network.names)
        network.divide(name, True)
        time.sleep(dice.uniform(0.3, 2.5 * LEASE))
        network.divide(name, False)
        time.sleep(dice.uniform(0.2, 1))
    print(f"{args.partitions} partitions; {len(clients.jobs)} jobs accepted", flush=True)
    queue = cluster.nats.process
    stop, go_on = (lambda: queue.send_signal(signal.SIGSTOP)), (lambda: queue.send_signal(signal.SIGCONT))
    good &= away("NATS", port, structure, key, stop, go_on)
    hidden = cluster.store + ".away"
    hide, show = (lambda: os.rename(cluster.store, hidden)), (lambda: os.rename(hidden, cluster.store))
    good &= away("the store", port, structure, key, hide, show)
    clients.finish()
    deadline = time.monotonic() + FINISH_TIMEOUT
    ends = collections.Counter(outcome(port, job, mesh, deadline) for job, mesh in clients.jobs.items())
    print(f"{len(clients.jobs)} accepted jobs: {dict(ends)}")
    return good and set(ends) == {"successful"}


if __name__ == "__main__":
    main()
