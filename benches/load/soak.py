#!/usr/bin/env python3
"""Checks for leaks and growth of memory under an hour of mixed load.

    python3 benches/load/soak.py target/release/molmesh samples/4pti.pdb samples/1crn.cif --minutes 60 --warm-up 5

The script first measures the peak rate, then sends requests at half of it or at `--rate`. Every five seconds it samples
resident memory, threads, open files by kind, and the gauges of memory, jobs and connections. Stored objects expire
after 90 seconds, caches are small, and the warm-up fills them, so that any further growth is a leak.

A leak raises the lowest resident memory of each minute, and running jobs hardly change it. Structures in memory, up to
their limit, are subtracted, also from the values before and after the load. The slope is that of Theil and Sen: the
median of the slopes between all pairs of minutes. The 95 % interval is a bootstrap of the residuals in blocks of five
minutes, because neighbouring minutes depend on each other. Idle threads keep a few MiB each, so a change of their
number is printed beside the slope.

The exit code is 1 if a response was wrong, if a count has increased, if the upper end of the interval is above 1 % per
hour, or if the resident memory two minutes after the load is more than 20 % above its idle value. That is the value two
minutes after the first load, which creates threads and tables that remain.
"""

import argparse
import collections
import itertools
import json
import os
import random
import re
import sys
import time
from statistics import median

from mixed import Expected, Load, Server, folder

KEPT = ["store.result_ttl_ms=90000", "store.input_ttl_ms=90000"]
KEPT += ["store.max_bytes=2GiB", "limits.structure_cache_bytes=8MiB"]
# Limits of the growth of the resident memory, % per hour, and of its excess over the idle value, %.
MAX_GROWTH, MAX_EXCESS = 1.0, 20.0
# Seconds without requests after which all stored objects have expired and all connections are closed.
REST = 170
# Minutes per block and number of series of the bootstrap.
BLOCK, RESAMPLED = 5, 400
GAUGES = ("molmesh_memory_held_bytes", "molmesh_broker_jobs_queued", "molmesh_connections", "molmesh_queue_depth")
# Structures in memory: they fill their limit during the warm-up or later, and stay.
CACHE = "molmesh_structure_cache_bytes"


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
    held = {gauge: server.metric(gauge) for gauge in (*GAUGES, CACHE)}
    return {"rss": int(numbers["VmRSS"]) * 1024, "threads": int(numbers["Threads"]), **kinds, **held}


def slope(points):
    """Returns the slope of Theil and Sen of pairs of time and value."""
    pairs = itertools.combinations(points, 2)
    return median((y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in pairs)


def growth(samples):
    """Returns the growth of the lowest memory of each minute, without structures in memory, in % per hour. The ends of
    its 95 % interval follow."""
    minutes = collections.defaultdict(list)
    for sample in samples:
        minutes[int(sample["at"] // 60)].append(sample["rss"] - sample.get(CACHE, 0))
    points = [(minute / 60, min(values)) for minute, values in sorted(minutes.items())]
    estimate = slope(points)
    middle = median(y - estimate * x for x, y in points)
    residuals = [y - estimate * x - middle for x, y in points]
    dice = random.Random(1)
    slopes = []
    for _ in range(RESAMPLED):
        drawn = []
        while len(drawn) < len(points):
            begin = dice.randrange(max(len(points) - BLOCK, 0) + 1)
            drawn += residuals[begin : begin + BLOCK]
        slopes.append(slope([(x, estimate * x + residual) for (x, _), residual in zip(points, drawn)]))
    slopes.sort()
    scale = 100 / median(y for _, y in points)
    return tuple(scale * s for s in (estimate, slopes[RESAMPLED // 40], slopes[-1 - RESAMPLED // 40]))


def control():
    """Checks that `growth` resolves the limit: it must pass a flat hour and fail one that grows by 2 % per hour."""
    dice = random.Random(2)
    for percent, passes in ((0, True), (2, False)):
        floor = [(at, 1e8 * (1 + percent / 100 * at / 3600)) for at in range(0, 3600, 5)]
        hour = [{"at": at, "rss": rss + dice.expovariate(1e-7)} for at, rss in floor]
        assert (growth(hour)[2] <= MAX_GROWTH) == passes, f"{percent} %/h: {growth(hour)}"


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("structures", nargs="+")
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--warm-up", type=float, default=5)
    parser.add_argument("--clients", type=int, default=12)
    parser.add_argument("--rate", type=float, help="requests per second; default: half of the peak")
    parser.add_argument("--port", type=int, default=18490)
    parser.add_argument("--samples", help="file for all samples, as JSON")
    args = parser.parse_args()
    control()
    server = Server(args.binary, folder(), args.port, ["--backend", "cpu", *itertools.chain(*(("--set", k) for k in KEPT))])
    expected = Expected(args.binary, args.structures)
    server.start()

    # The first requests create threads and connections that remain, so `before` is sampled after them.
    peak = Load(args.port, expected, args.clients, later=20)
    peak.start()
    time.sleep(20)
    peak.finish()
    peak.follow_deferred()
    peak_rate = peak.counts["requests"] / 20
    rate = args.rate or peak_rate / 2
    time.sleep(REST)
    before = sample_process(server)
    idle = f"{before['rss'] / 2**20:.1f} MiB"
    print(f"peak {peak_rate:.1f} requests/s; idle {idle}; now {rate:.1f} for {args.minutes:g} minutes", flush=True)

    load = Load(args.port, expected, args.clients, seed=1000, every=1 / rate, later=20)
    begin, samples = time.monotonic(), []
    load.start()
    while (at := time.monotonic() - begin) < 60 * args.minutes:
        samples.append({"at": at, **sample_process(server)})
        if len(samples) % 60 == 0:
            print(f"{at / 60:5.1f} min: {samples[-1]['rss'] / 2**20:.1f} MiB, {load.counts['requests']} requests", flush=True)
        time.sleep(5)
    load.finish()
    load.follow_deferred()
    sent = load.counts["requests"] / (60 * args.minutes)
    time.sleep(REST)
    # The metrics may count their own connection while it closes, so sample several times.
    for _ in range(10):
        after = sample_process(server)
        if all(after.get(what, 0) <= before.get(what, 0) for what in after.keys() - {"rss", CACHE}):
            break
        time.sleep(2)
    if args.samples:
        with open(args.samples, "w") as file:
            json.dump({"before": before, "samples": samples, "after": after}, file)

    warm = [sample for sample in samples if sample["at"] >= 60 * args.warm_up]
    middle = median(sample["rss"] for sample in warm)
    per_hour, low, high = growth(warm)
    excess = 100 * ((after["rss"] - after.get(CACHE, 0)) / (before["rss"] - before.get(CACHE, 0)) - 1)
    print(load.report())
    print(f"pace: {sent:.1f} requests/s, {100 * sent / peak_rate:.0f} % of the peak")
    interval = f"95 % interval {low:+.2f} to {high:+.2f}"
    print(f"resident memory after {args.warm_up:g} minutes: median {middle / 2**20:.1f} MiB, slope {per_hour:+.2f} %/h ({interval})")
    for part, name in ((warm[: len(warm) // 3], "first"), (warm[-len(warm) // 3 :], "last")):
        rss, kept, threads = (median(sample[what] for sample in part) for what in ("rss", CACHE, "threads"))
        print(f"{name} third: {rss / 2**20:.1f} MiB, {kept / 2**20:.1f} MiB of it structures in memory; {threads:g} threads")
    print(f"two minutes after the load: {after['rss'] / 2**20:.1f} MiB, {excess:+.1f} % of the idle {idle}")
    wrong = []
    if high > MAX_GROWTH:
        more = "grows by more than" if low > MAX_GROWTH else "is not shown to grow by at most"
        wrong.append(f"resident memory {more} {MAX_GROWTH:g} %/h")
    if excess > MAX_EXCESS:
        wrong.append(f"resident memory stays more than {MAX_EXCESS:g} % above idle")
    leaked = []
    for what in sorted(before.keys() | after.keys()):
        if what not in ("rss", CACHE):
            print(f"{what:28} {before.get(what, 0):12g} before {after.get(what, 0):12g} after")
            if after.get(what, 0) > before.get(what, 0):
                leaked.append(what)
    code, took = server.stop()
    print(f"stopped in {took:.2f} s with {code}")
    if leaked:
        wrong.append(f"more than before: {', '.join(leaked)}")
    if load.bad() or code:
        wrong.append("wrong answers or exit code: see above")
    if wrong:
        sys.exit("; ".join(wrong))


main()
