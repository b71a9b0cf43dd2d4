#!/usr/bin/env python3
"""Checks for leaks and growth of memory under half an hour of mixed load at half of the peak rate.

    python3 benches/load/soak.py target/release/molmesh samples/4pti.pdb samples/1crn.cif --minutes 30 --warm-up 5

The script first measures the peak rate, then sends requests at half of it. Every five seconds it samples resident
memory, threads, open files by kind, and the gauges of memory, jobs and connections. Stored objects expire after 90
seconds, and the warm-up reaches the limits of the store, so that any further growth is a leak. The slope is that of
Theil and Sen: the median of the slopes between all pairs of samples. After a pause, the counts are compared with those
before the load. The exit code is 1 if a response was wrong or a count has increased.
"""

import argparse
import collections
import itertools
import json
import os
import re
import sys
import time
from statistics import median

from mixed import Expected, Load, Server, folder

KEPT = ["store.result_ttl_ms=90000", "store.input_ttl_ms=90000", "store.job_ttl_ms=90000", "store.sweep_ms=10000"]
KEPT += ["store.max_bytes=2GiB", "store.memory_bytes=32MiB"]
GAUGES = ("molmesh_memory_held_bytes", "molmesh_jobs_open", "molmesh_connections", "molmesh_queue_depth")


def sample_process(server):
    """Samples memory, threads, files and gauges of the process."""
    process = f"/proc/{server.process.pid}"
    with open(f"{process}/status") as status:
        numbers = dict(re.findall(r"^(VmRSS|Threads):\s+(\d+)", status.read(), re.M))
    kinds = collections.Counter()
    for number in os.listdir(f"{process}/fd"):
        try:
            target = os.readlink(f"{process}/fd/{number}")
        except OSError:
            continue
        kinds[re.match(r"(socket|pipe|anon_inode)|", target)[0] or "file"] += 1
    held = {gauge: server.metric(gauge) for gauge in GAUGES}
    return {"rss": int(numbers["VmRSS"]) * 1024, "threads": int(numbers["Threads"]), **kinds, **held}


def slope(samples):
    """Returns the change of the resident memory, bytes per second."""
    pairs = itertools.combinations(samples, 2)
    return median((b["rss"] - a["rss"]) / (b["at"] - a["at"]) for a, b in pairs)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("structures", nargs="+")
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--warm-up", type=float, default=5)
    parser.add_argument("--clients", type=int, default=12)
    parser.add_argument("--port", type=int, default=18490)
    parser.add_argument("--samples", help="file for all samples, as JSON")
    args = parser.parse_args()
    server = Server(args.binary, folder(), args.port, ["--backend", "cpu", *itertools.chain(*(("--set", k) for k in KEPT))])
    expected = Expected(args.binary, args.structures)
    server.start()

    # The first requests create threads and connections that remain, so `before` is sampled after them.
    peak = Load(args.port, expected, args.clients, later=20)
    peak.start()
    time.sleep(20)
    peak.finish()
    peak.settle()
    rate = peak.counts["requests"] / 20
    time.sleep(10)
    before = sample_process(server)
    print(f"peak {rate:.1f} requests/s; now {rate / 2:.1f} for {args.minutes:g} minutes", flush=True)

    load = Load(args.port, expected, args.clients, seed=1000, every=2 / rate, later=20)
    begin, samples = time.monotonic(), []
    load.start()
    while (at := time.monotonic() - begin) < 60 * args.minutes:
        samples.append({"at": at, **sample_process(server)})
        if len(samples) % 60 == 0:
            print(f"{at / 60:5.1f} min: {samples[-1]['rss'] / 2**20:.1f} MiB, {load.counts['requests']} requests", flush=True)
        time.sleep(5)
    load.finish()
    load.settle()
    asked = load.counts["requests"] / (60 * args.minutes)
    # Wait until all stored objects have expired and all connections are closed.
    time.sleep(120)
    # The metrics may count their own connection while it closes, so sample several times.
    for _ in range(10):
        after = sample_process(server)
        if all(after.get(what, 0) <= before.get(what, 0) for what in after.keys() - {"rss"}):
            break
        time.sleep(2)
    if args.samples:
        with open(args.samples, "w") as file:
            json.dump({"before": before, "samples": samples, "after": after}, file)

    warm = [sample for sample in samples if sample["at"] >= 60 * args.warm_up]
    middle = median(sample["rss"] for sample in warm)
    growth = 100 * 3600 * slope(warm) / middle
    print(load.report())
    print(f"pace: {asked:.1f} requests/s, {100 * asked / rate:.0f} % of the peak")
    print(f"resident memory: median {middle / 2**20:.1f} MiB, slope {growth:+.2f} %/h after {args.warm_up:g} minutes")
    leaked = []
    for what in sorted(before.keys() | after.keys()):
        if what != "rss":
            print(f"{what:28} {before.get(what, 0):12g} before {after.get(what, 0):12g} after")
            if after.get(what, 0) > before.get(what, 0):
                leaked.append(what)
    code, took = server.stop()
    print(f"stopped in {took:.2f} s with {code}")
    if load.bad() or leaked or code:
        sys.exit(f"errors occurred: see above; more than before: {', '.join(leaked) or 'nothing'}")


main()
