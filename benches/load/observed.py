#!/usr/bin/env python3
"""Measures the cost of metrics and traces in requests per second.

    python3 benches/load/observed.py target/release/molmesh samples/4pti.pdb --rounds 9 --seconds 4

Three servers of the same binary run in parallel with separate data: `off` (no metrics, no traces), `metrics` (scraped
every second), and `all` (metrics, and all spans sent to a collector in this script). They are measured in turn, one at
a time, by `--clients` clients with persistent connections. Figures are medians of the rounds, ratios are medians of the
ratios within a round. There are three kinds of requests: new meshes at the default grid (each with a new remark), new
meshes at a coarse grid, where overhead dominates, and a mesh that is cached in memory.

The clients and the collector share the machine with the servers, and use more time than the measured difference. The
script therefore also prints the processor time of the server per request.
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
    """Collector that counts the bytes of all batches."""

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

    def cpu(self):
        """Returns the processor time used by the server, s."""
        with open(f"/proc/{self.process.pid}/stat") as stat:
            fields = stat.read().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

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


async def measure(service, request, seconds, clients):
    """Returns the requests per second, and the processor time of the server per request, µs."""
    counts, cpu, begin = [0], service.cpu(), time.perf_counter()
    await asyncio.gather(*(client(service.port, request, begin + seconds, counts) for _ in range(clients)))
    rate = counts[0] / (time.perf_counter() - begin)
    return rate, 1e6 * (service.cpu() - cpu) / counts[0]


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

    def post(resolution, body):
        head = f"POST /v1/meshes?resolution={resolution} HTTP/1.1\r\nhost: x\r\ncontent-length: {len(body)}\r\n\r\n"
        return head.encode() + body

    def fresh(resolution):
        return lambda: post(resolution, structure + b"REMARK 900 %d %d\n" % (os.getpid(), next(count)))

    same = post(3, structure)
    print(f"{'':12} {'':8} {'requests/s':>12} {'of off':>9} {'us of the server':>18} {'of off':>9}")
    for what, request in (("default grid", fresh(0.5)), ("coarse grid", fresh(3)), ("from memory", lambda: same)):
        rounds = []
        for n in range(args.rounds + 1):
            # Alternate the order of the servers.
            turn = services if n % 2 else services[::-1]
            took = {s.name: asyncio.run(measure(s, request, args.seconds, args.clients)) for s in turn}
            if n > 0:
                rounds.append(took)
        for service in services:
            line = f"{what:12} {service.name:8}"
            for column, width, digits in ((0, 12, 1), (1, 18, 1)):
                figure = median(r[service.name][column] for r in rounds)
                ratio = median(r[service.name][column] / r["off"][column] for r in rounds)
                line += f" {figure:{width}.{digits}f} {100 * (ratio - 1):+8.2f}%"
            print(line, flush=True)
    print(f"bytes of spans: {Collector.bytes}")
    for service in services:
        service.stop()


main()
