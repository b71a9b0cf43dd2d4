#!/usr/bin/env python3
"""Half an hour of mixed load at half of what the service can do: does memory grow, does anything leak?

    python3 benches/load/soak.py target/release/molmesh samples/4pti.pdb samples/1crn.cif --minutes 30 --warm-up 5

The peak is measured first, by as many clients as can be served. Then questions come at half that pace. Every five seconds the
process is looked at: resident memory, threads, open files by what they are, and its own gauges of leases, jobs and connections.
What is kept is forgotten after a minute and a half and bounded to sizes that the warm-up reaches, so that what still grows
afterwards would grow for ever. The slope is Theil and Sen's: the median of all slopes between two samples. The counts are
compared with those before the load, after a pause. Ends with 1 if an answer was wrong or a count did not come back.
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


def look(server):
    """What the process holds now."""
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
    """Change of the resident memory a second."""
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
    parser.add_argument("--samples", help="file for every sample, as JSON")
    args = parser.parse_args()
    server = Server(args.binary, folder(), args.port, ["--backend", "cpu", *itertools.chain(*(("--set", k) for k in KEPT))])
    expected = Expected(args.binary, args.structures)
    server.start()

    # The first requests make threads and connections that stay; what is counted as "before" is after them.
    peak = Load(args.port, expected, args.clients, later=20)
    peak.start()
    time.sleep(20)
    peak.finish()
    peak.settle()
    rate = peak.counts["questions"] / 20
    time.sleep(10)
    before = look(server)
    print(f"peak {rate:.1f} questions/s; now {rate / 2:.1f} for {args.minutes:g} minutes", flush=True)

    load = Load(args.port, expected, args.clients, seed=1000, every=2 / rate, later=20)
    begin, samples = time.monotonic(), []
    load.start()
    while (at := time.monotonic() - begin) < 60 * args.minutes:
        samples.append({"at": at, **look(server)})
        if len(samples) % 60 == 0:
            print(f"{at / 60:5.1f} min: {samples[-1]['rss'] / 2**20:.1f} MiB, {load.counts['questions']} questions", flush=True)
        time.sleep(5)
    load.finish()
    load.settle()
    asked = load.counts["questions"] / (60 * args.minutes)
    # Everything that was kept is forgotten, every connection closed.
    time.sleep(120)
    # The connection that asked for the metrics may be counted while it closes: a few looks, and what stays has stayed.
    for _ in range(10):
        after = look(server)
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
    print(f"pace: {asked:.1f} questions/s, {100 * asked / rate:.0f} % of the peak")
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
        sys.exit(f"something is bad: see above; more than before: {', '.join(leaked) or 'nothing'}")


main()
