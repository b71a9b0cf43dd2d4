#!/usr/bin/env python3
"""Thousands of listeners to the events of one job: what each costs, and how late events are.

    molmesh serve --listen 127.0.0.1:8080 --backend reference --set archive.url=none --set server.connections=4000 --set jobs.workers=1 &
    python3 benches/load/listeners.py http://127.0.0.1:8080 samples/4pti.pdb --pid $!

Long jobs of the slow reference backend, which takes little memory, keep the only worker busy; the listeners watch another one, which waits. Then the long ones are cancelled, so that
the watched one runs and ends: the lag is the time from its `finished` (by the service's clock, on this machine) to the event.
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


def promise(url, structure, query):
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


async def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("structure")
    parser.add_argument("--listeners", type=int, default=2000)
    parser.add_argument("--pid", type=int, required=True)
    args = parser.parse_args()
    parts = urlsplit(args.url)
    structure = open(args.structure, "rb").read()
    remark = lambda n: structure + b"REMARK 900 %d\n" % n
    long = [promise(args.url, remark(n), "?resolution=0.3") for n in range(20)]
    watched = promise(args.url, structure, "?resolution=2")
    await asyncio.sleep(1)
    before = memory(args.pid)
    ready, lags = asyncio.Semaphore(0), []
    tasks = [asyncio.create_task(listen(parts.hostname, parts.port, watched, ready, lags)) for _ in range(args.listeners)]
    for _ in tasks:
        await ready.acquire()
    await asyncio.sleep(2)
    each = (memory(args.pid) - before) / args.listeners
    for job in long:
        try:
            urllib.request.urlopen(urllib.request.Request(f"{args.url}/v1/jobs/{job}", method="DELETE"))
        except urllib.error.HTTPError:
            pass  # It has ended.
    await asyncio.wait_for(asyncio.gather(*tasks), 60)
    cuts = quantiles(lags, n=100)
    print(f"{len(lags)} listeners, {each / 1024:.1f} KiB each; lag p50 {1e3 * cuts[49]:.0f} ms, p99 {1e3 * cuts[98]:.0f} ms")


asyncio.run(main())
