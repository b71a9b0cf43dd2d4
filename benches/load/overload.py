#!/usr/bin/env python3
"""Measures rejections and the accuracy of Retry-After with ten times more clients than the service can hold.

    molmesh serve --listen 127.0.0.1:8080 --set archive.url=none &
    python3 benches/load/overload.py http://127.0.0.1:8080 samples/4pti.pdb --seconds 120

The script first measures the peak with one client more than there are workers, none of which is rejected. Then it
starts `--times` as many clients as the workers and the queue hold. Each client posts unique structures, one after
another, and retries after Retry-After. A Retry-After of r seconds is accurate if the job is accepted within 2r seconds.
Since r is at least one second, earlier is accurate, too. Prints one line per figure.
"""

import argparse
import asyncio
import json
import os
import time
import urllib.request
from statistics import quantiles
from urllib.parse import urlsplit


async def post(host, port, path, body):
    """Posts a body. Returns status, Retry-After, and the time to the head of the response, s."""
    begin = time.perf_counter()
    reader, writer = await asyncio.open_connection(host, port)
    try:
        head = f"POST {path} HTTP/1.1\r\nhost: {host}\r\nconnection: close\r\ncontent-length: {len(body)}\r\n\r\n"
        writer.write(head.encode() + body)
        await writer.drain()
        status = int((await reader.readline()).split()[1])
        retry = None
        while (line := await reader.readline()) not in (b"\r\n", b""):
            name, _, value = line.decode("latin-1").partition(":")
            if name.lower() == "retry-after":
                retry = int(value)
        took = time.perf_counter() - begin
        while await reader.read(1 << 20):
            pass
        return status, retry, took
    finally:
        writer.close()


class Load:
    def __init__(self, url, structure, resolution):
        parts = urlsplit(url)
        self.host, self.port = parts.hostname, parts.port or 80
        self.path = f"/v1/meshes?resolution={resolution}"
        self.structure, self.n = structure, 0
        self.done, self.refusals, self.ratios, self.retry_after, self.errors = 0, [], [], [], 0

    def body(self):
        """Returns the structure with a unique remark: the same work, but different content."""
        self.n += 1
        return self.structure + b"REMARK 900 %d %d\n" % (os.getpid(), self.n)

    async def client(self, end):
        while time.perf_counter() < end:
            body, refused, wait = self.body(), None, None
            while time.perf_counter() < end:
                try:
                    status, retry, took = await post(self.host, self.port, self.path, body)
                except (OSError, IndexError, ValueError):
                    self.errors += 1
                    await asyncio.sleep(0.1)
                    continue
                now = time.perf_counter()
                if status == 503 and retry is not None:
                    self.refusals.append(took)
                    if refused is None:
                        refused, wait = now, retry
                    self.retry_after.append(retry)
                    await asyncio.sleep(min(retry, max(0, end - now)))
                    continue
                if status != 200:
                    self.errors += 1
                elif now < end:
                    self.done += 1
                if refused is not None:
                    # The job was accepted at most `took` before the response.
                    self.ratios.append((now - took - refused) / wait)
                break


def memory(pid):
    for line in open(f"/proc/{pid}/status"):
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024


def buckets(url, status):
    """Returns the histogram of request durations of the service, as (upper bound in s, cumulative requests)."""
    found = {}
    for line in urllib.request.urlopen(f"{url}/metrics").read().decode().splitlines():
        if line.startswith("http_server_request_duration_seconds_bucket") and f'status="{status}"' in line:
            bound = line.split('le="')[1].split('"')[0]
            found[float(bound)] = found.get(float(bound), 0) + float(line.rsplit(" ", 1)[1])
    return sorted(found.items())


async def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("url")
    parser.add_argument("structure")
    parser.add_argument("--seconds", type=float, default=120)
    parser.add_argument("--times", type=float, default=10)
    parser.add_argument("--resolution", default="0.3")
    parser.add_argument("--pid", type=int, help="process of the service, to measure its memory")
    parser.add_argument("--metrics", help="base URL of the metrics listener, to measure rejections by the clock of the service")
    args = parser.parse_args()
    limits = json.load(urllib.request.urlopen(f"{args.url}/v1/capabilities"))["limits"]
    structure = open(args.structure, "rb").read()
    warm = Load(args.url, structure, args.resolution)
    begin = time.perf_counter()
    await asyncio.gather(*(warm.client(begin + 10) for _ in range(limits["workers"] + 1)))
    peak = warm.done / 10
    print(f"peak            {peak:8.1f} meshes/s ({limits['workers'] + 1} clients)")
    clients = int(args.times * (limits["workers"] + limits["queue"]))
    load, samples = Load(args.url, structure, args.resolution), []

    async def watch(end):
        while args.pid and time.perf_counter() < end:
            samples.append(memory(args.pid))
            await asyncio.sleep(1)

    end = time.perf_counter() + args.seconds
    await asyncio.gather(watch(end), *(load.client(end) for _ in range(clients)))
    percent = lambda values, p: quantiles(values, n=100)[p - 1] if len(values) > 1 else float("nan")
    right = sum(1 for r in load.ratios if r <= 2) / max(1, len(load.ratios))
    print(f"clients         {clients:8d}")
    print(f"goodput         {load.done / args.seconds:8.1f} meshes/s, {100 * load.done / args.seconds / peak:.0f} % of the peak")
    print(f"refusals        {len(load.refusals):8d}, p50 {1e3 * percent(load.refusals, 50):.1f} ms, p99 {1e3 * percent(load.refusals, 99):.1f} ms")
    if args.metrics:
        refused = buckets(args.metrics, 503)
        share = lambda bound: 100 * max((n for b, n in refused if b <= bound), default=0) / max(1, refused[-1][1] if refused else 1)
        print(f"  by the service's clock, body included: {share(0.01):.1f} % within 10 ms, {share(0.05):.1f} % within 50 ms")
    print(f"Retry-After     {100 * right:8.1f} % right within a factor of 2; ratio p50 {percent(load.ratios, 50):.2f}, p90 {percent(load.ratios, 90):.2f}, p99 {percent(load.ratios, 99):.2f}")
    print(f"wait            p50 {percent(load.retry_after, 50):.0f} s, p99 {percent(load.retry_after, 99):.0f} s, longest {max(load.retry_after, default=0)} s")
    print(f"errors          {load.errors:8d}")
    if samples:
        third = len(samples) // 3
        first, last = sorted(samples[third : 2 * third])[third // 2], sorted(samples[2 * third :])[third // 2]
        print(f"memory          {first:8.0f} MiB in the middle third, {last:.0f} MiB in the last")


asyncio.run(main())
