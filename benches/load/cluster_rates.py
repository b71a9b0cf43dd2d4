#!/usr/bin/env python3
"""Measures a cluster: the time to accept a job, the time from its acceptance to its result, and jobs per second.

    python3 benches/load/cluster_rates.py target/release/molmesh NATS-SERVER samples/4pti.pdb

Compares a service alone with clusters of one, two and three workers, each with one thread. The rate of several workers
is limited by the cores of the machine.
"""

import argparse
import http.client
import os
import threading
import time

from cluster import Cluster
from mixed import Server, fetch, folder


def accept(port, structure, number, resolution):
    """Submits jobs on one connection. Returns their addresses and the times to accept them, s."""
    connection, jobs, times = http.client.HTTPConnection("127.0.0.1", port), [], []
    for n in range(number):
        begun = time.perf_counter()
        connection.request("POST", f"/v1/meshes?resolution={resolution}&isovalue={1 + n / 1e5:.5f}&format=stl", structure, {"prefer": "respond-async"})
        response = connection.getresponse()
        response.read()
        times.append(time.perf_counter() - begun)
        assert response.status == 202, response.status
        jobs.append(response.headers["location"])
    return jobs, times


def rate(port, jobs):
    """Returns the number of jobs that end per second, from now on."""
    begun = time.perf_counter()
    for job in jobs:
        while b'"successful"' not in fetch(port, "GET", f"{job}?wait=20")[2]:
            pass
    return len(jobs) / (time.perf_counter() - begun)


def report(what, port, structure, args):
    jobs, times = accept(port, structure, args.jobs, args.resolution)
    times.sort()
    done = rate(port, jobs)
    ms = [1e3 * times[len(times) * percent // 100] for percent in (50, 99)]
    # One job at a time: acceptance, claim, mesh, result.
    whole = []
    for n in range(20):
        begun = time.perf_counter()
        path = f"/v1/meshes?resolution=2&isovalue={1.5 + n / 1e5:.5f}&format=stl"
        job = fetch(port, "POST", path, structure, {"prefer": "respond-async"})[1]["location"]
        rate(port, [job])
        whole.append(time.perf_counter() - begun)
    whole.sort()
    print(f"{what:30} accepted in p50 {ms[0]:.2f} ms, p99 {ms[1]:.2f} ms; {done:.0f} jobs/s; one job {1e3 * whole[10]:.0f} ms", flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("nats")
    parser.add_argument("structure")
    parser.add_argument("--jobs", type=int, default=400)
    parser.add_argument("--resolution", default="1", help="grid spacing of the jobs, A")
    parser.add_argument("--port", type=int, default=18900)
    args = parser.parse_args()
    os.environ["RAYON_NUM_THREADS"] = "1"
    with open(args.structure, "rb") as file:
        structure = file.read()
    alone = Server(args.binary, folder(), args.port, ["--backend", "cpu", "--set", "jobs.workers=1"])
    alone.start()
    report("a service alone", args.port, structure, args)
    alone.stop()
    for workers in (1, 2, 3):
        cluster = Cluster(args.binary, args.nats, args.port + 100 * workers, ["api"] + workers * ["worker"], ["jobs.workers=1"])
        cluster.start()
        report(f"{workers} workers", cluster.of_role("api")[0].port, structure, args)
        cluster.stop()


if __name__ == "__main__":
    main()
