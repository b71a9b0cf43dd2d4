#!/usr/bin/env python3
"""Measures memory per listener and lag of events with thousands of listeners to the events of one job.

    molmesh serve --listen 127.0.0.1:8080 --backend reference \\
        --set archive.url=none --set server.connections=4000 --set jobs.workers=1 &
    python3 benches/load/listeners.py http://127.0.0.1:8080 samples/4pti.pdb --pid $!

Long jobs of the slow reference backend keep the only worker busy. The listeners watch a job that is queued behind them.
The long jobs are then cancelled, so that the watched job runs and ends. The lag is the time from its `finished` (by the
clock of the service, on this machine) to the event.

The memory per listener is the increase of the resident memory (VmRSS) of the server with the second half of the
listeners, divided by their number. The first half reuses memory that earlier work has freed. The long jobs have many
atoms on few grid points, so that their memory is small and constant. The change of the memory without listeners is also
printed.
"""

import argparse
import asyncio
import datetime
import json
import time
import urllib.error
import urllib.request
from statistics import quantiles
from urllib.parse import urlsplit


def memory(pid):
    for line in open(f"/proc/{pid}/status"):
        if line.startswith("VmRSS"):
            return int(line.split()[1]) * 1024


def start_job(url, structure, query):
    request = urllib.request.Request(f"{url}/v1/meshes{query}", structure, {"Prefer": "respond-async"})
    return json.load(urllib.request.urlopen(request))["jobID"]


async def listen(host, port, job, ready, lags):
    reader, writer = await asyncio.open_connection(host, port)
    writer.write(f"GET /v1/jobs/{job}/events HTTP/1.1\r\nhost: {host}\r\n\r\n".encode())
    seen = False
    while line := await reader.readline():
        if line.startswith(b"data: "):
            document = json.loads(line[6:])
            if not seen:
                seen = True
                ready.release()
            if document["finished"]:
                finished = datetime.datetime.fromisoformat(document["finished"])
                lags.append(time.time() - finished.timestamp())
                break
    writer.close()


def crowd(structure, times):
    """Returns the atoms of the structure, repeated `times` times in place: much work on a small grid."""
    atoms = b"".join(line for line in structure.splitlines(keepends=True) if line.startswith(b"ATOM"))
    return atoms * times


async def steady_memory(pid):
    """Returns the resident memory after it has stayed within 64 KiB for two seconds, bytes."""
    seen = [memory(pid)]
    for _ in range(60):
        await asyncio.sleep(0.5)
        seen = [*seen[-4:], memory(pid)]
        if len(seen) == 5 and max(seen) - min(seen) <= 64 << 10:
            break
    return seen[-1]


async def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("structure")
    parser.add_argument("--listeners", type=int, default=2000)
    parser.add_argument("--pid", type=int, required=True)
    args = parser.parse_args()
    parts = urlsplit(args.url)
    structure = open(args.structure, "rb").read()
    crowded = crowd(structure, 200)
    long = [start_job(args.url, crowded + b"REMARK 900 %d\n" % n, "?resolution=0.7") for n in range(24)]
    watched = start_job(args.url, structure, "?resolution=2")
    alone = await steady_memory(args.pid)
    await asyncio.sleep(3)
    before = await steady_memory(args.pid)
    ready, lags, tasks, taken = asyncio.Semaphore(0), [], [], []
    for _ in range(2):
        for _ in range(args.listeners // 2):
            tasks.append(asyncio.create_task(listen(parts.hostname, parts.port, watched, ready, lags)))
        for _ in range(args.listeners // 2):
            await ready.acquire()
        taken.append(await steady_memory(args.pid))
    each = (taken[1] - taken[0]) / (args.listeners // 2)
    if lags:
        raise SystemExit("the long jobs were too short")
    # Cancel the last ones first, so that none of them starts.
    for job in reversed(long):
        try:
            urllib.request.urlopen(urllib.request.Request(f"{args.url}/v1/jobs/{job}", method="DELETE"))
        except urllib.error.HTTPError:
            pass  # It has ended.
    await asyncio.wait_for(asyncio.gather(*tasks), 60)
    cuts = quantiles(lags, n=100)
    print(
        f"{len(lags)} listeners, {each / 1024:.1f} KiB each (by all of them {(taken[1] - before) / len(lags) / 1024:.1f}; "
        f"without them the memory moved by {(before - alone) / 1024:.0f} KiB); "
        f"lag p50 {1e3 * cuts[49]:.0f} ms, p99 {1e3 * cuts[98]:.0f} ms"
    )


asyncio.run(main())
