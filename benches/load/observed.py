#!/usr/bin/env python3
"""What it costs to be watched: requests a second with metrics and traces, and without.

    python3 benches/load/observed.py target/release/molmesh samples/4pti.pdb --rounds 9 --seconds 4

Three servers of the same binary run side by side on data of their own: `off` (no metrics, no traces), `metrics` (read every
second), `all` (metrics, and every span sent to a collector that this script plays). They are asked in turn, round by round, one
at a time, by `--clients` clients on connections that are kept; each figure is the median of the rounds, each ratio the
median of the ratios within a round. Two kinds of requests: meshes that must be computed (a fresh remark each, at a coarse
grid, so that what surrounds the computing counts), and a mesh that lies in memory.
"""

import argparse
import asyncio
import http.server
import os
import re
import subprocess
import tempfile
import threading
import time
import urllib.request
from statistics import median


class Collector(http.server.BaseHTTPRequestHandler):
    """Takes every batch, and counts it."""

    protocol_version = "HTTP/1.1"
    bytes = 0

    def do_POST(self):
        Collector.bytes += len(self.rfile.read(int(self.headers["content-length"])))
        self.send_response(200)
        self.send_header("content-length", "0")
        self.end_headers()

    def log_message(self, *_):
        pass


class Service:
    def __init__(self, binary, name, extra):
        self.name, self.folder = name, tempfile.TemporaryDirectory()
        command = [binary, "serve", "--listen", "127.0.0.1:0", "--backend", "cpu", "--data-dir", self.folder.name]
        command += ["--set", "archive.url=none", *extra]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        ports = []
        for line in self.process.stderr:
            ports += re.findall(r"http://127\.0\.0\.1:(\d+)", line)
            if len(ports) > ("--metrics-listen" in extra):
                break
        self.port, self.metrics = int(ports[0]), ports[1] if len(ports) > 1 else None
        threading.Thread(target=lambda: [None for _ in self.process.stderr], daemon=True).start()
        if self.metrics:
            threading.Thread(target=self.read, daemon=True).start()
        while True:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{self.port}/readyz").read()
                return
            except OSError:
                time.sleep(0.05)

    def read(self):
        while self.process.poll() is None:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{self.metrics}/metrics").read()
            except OSError:
                return
            time.sleep(1)

    def stop(self):
        self.process.terminate()
        self.process.wait()


async def client(port, request, end, counts):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    while time.perf_counter() < end:
        writer.write(request())
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
        if " 200 " not in head.split("\r\n")[0]:
            raise SystemExit(head)
        await reader.readexactly(int(re.search(r"content-length: (\d+)", head)[1]))
        counts[0] += 1
    writer.close()


async def measure(port, request, seconds, clients):
    counts, begin = [0], time.perf_counter()
    await asyncio.gather(*(client(port, request, begin + seconds, counts) for _ in range(clients)))
    return counts[0] / (time.perf_counter() - begin)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("structure")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=4)
    parser.add_argument("--clients", type=int, default=4)
    args = parser.parse_args()
    collector = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Collector)
    threading.Thread(target=collector.serve_forever, daemon=True).start()
    endpoint = f"telemetry.endpoint=http://127.0.0.1:{collector.server_port}"
    watched = ["--metrics-listen", "127.0.0.1:0"]
    services = [
        Service(args.binary, "off", []),
        Service(args.binary, "metrics", watched),
        Service(args.binary, "all", [*watched, "--set", endpoint]),
    ]
    with open(args.structure, "rb") as file:
        structure = file.read()
    count = iter(range(1 << 62))

    def fresh():
        body = structure + b"REMARK 900 %d %d\n" % (os.getpid(), next(count))
        return b"POST /v1/meshes?resolution=3 HTTP/1.1\r\nhost: x\r\ncontent-length: %d\r\n\r\n" % len(body) + body

    same = b"POST /v1/meshes?resolution=3 HTTP/1.1\r\nhost: x\r\ncontent-length: %d\r\n\r\n" % len(structure) + structure
    for what, request in (("computed", fresh), ("from memory", lambda: same)):
        rounds = []
        for n in range(args.rounds + 1):
            # Whoever comes first in one round comes last in the next.
            turn = services if n % 2 else services[::-1]
            rates = {s.name: asyncio.run(measure(s.port, request, args.seconds, args.clients)) for s in turn}
            if n > 0:
                rounds.append(rates)
        for service in services:
            rate = median(r[service.name] for r in rounds)
            ratio = median(r[service.name] / r["off"] for r in rounds)
            print(f"{what:12} {service.name:8} {rate:9.1f} /s  {100 * (ratio - 1):+6.2f} % of off", flush=True)
    print(f"bytes of spans: {Collector.bytes}")
    for service in services:
        service.stop()


main()
