#!/usr/bin/env python3
"""Attacks a service and measures its memory, its responses, and the latency of a healthy client.

    python3 benches/load/attack.py target/release/molmesh samples/4pti.pdb

Each attack has a service of its own, whose memory is really limited by a control group (or the size of the data
segment, where no group can be created):

- identical atoms, 300,000 and 10,000,000, with `radius_scale=10`
- small uploads with large documents or much work: names of 255 escaped characters, spheres of 50 Å with a search for
  pockets, nested distances, and a million atoms in as many chains
- a JSON document of 20 MB, and a form whose part header does not end
- 60 HTTP/2 connections with 64 requests each for one stored result, which take a byte of each body every ten seconds,
  while a healthy client on another loopback address measures its latency
- 100 of the largest uploads to every endpoint at once, in 2 GiB with the default configuration

The script prints a Markdown table. The exit code is 1 if a service dies or misses an aim. A control runs the last
attack with `limits.memory_bytes` far above the limit of the group, which the service must not survive.
"""

import argparse
import gzip
import http.client
import itertools
import json
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
from collections import Counter

from memory_group import MemoryGroup, status
from mixed import UNAVAILABLE, Server, fetch, folder
from slow_reader import SlowReader

MIB = 1 << 20
# Time in which memory must return to the system, s.
RETURN = 10
PORTS = itertools.count(18600, 2)


class Limited(Server):
    """Service in a memory group of `mib` MiB."""

    def __init__(self, binary, mib, sets=()):
        self.group = MemoryGroup(mib * MIB)
        # Without a group, the service cannot detect its limit.
        sets = [*([] if self.group.path else [f"limits.memory_bytes={mib // 2}MiB"]), *sets]
        super().__init__(binary, folder(), next(PORTS), ["--backend", "cpu", *itertools.chain(*(("--set", s) for s in sets))])

    def launch(self):
        with open(self.log, "ab") as log:
            self.process = subprocess.Popen(self.command, stdout=log, stderr=log, preexec_fn=self.group.enter)

    def __enter__(self):
        self.start()
        self.idle = self.memory("VmRSS")
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.group.remove()

    def memory(self, name):
        return status(self.process.pid)[name]

    def lives(self):
        return self.process.poll() is None

    def returned(self):
        """Waits until memory is near its idle value. Returns the time, s, or None after `RETURN`."""
        begin = time.monotonic()
        while time.monotonic() < begin + RETURN:
            if self.memory("VmRSS") < self.idle + 96 * MIB:
                return time.monotonic() - begin
            time.sleep(0.1)
        return None


class Table:
    """Results as Markdown rows. `missed` counts the aims that were missed."""

    def __init__(self):
        self.missed = 0
        self.row("attack or fault", "measured", "aim", "")
        print("|---|---|---|---|", flush=True)

    def row(self, *cells):
        print("| " + " | ".join(cells) + " |", flush=True)

    def add(self, attack, measured, aim, reached):
        self.missed += not reached
        self.row(attack, measured, aim, "yes" if reached else "**no**")


def slug(response):
    """Returns status and type of an response, such as `422 too-many-duplicates`."""
    code, _, body = response
    try:
        return f"{code} {json.loads(body)['type'].rpartition('/')[2]}"
    except (ValueError, KeyError, TypeError):
        return str(code)


def pdb(positions):
    atom = "ATOM      1  CA  ALA A   1    {:8.3f}{:8.3f}{:8.3f}  1.00  0.00           C  \n"
    return "".join(atom.format(*at) for at in positions).encode()


def identical_atoms(table, binary):
    line = pdb([(0, 0, 0)])
    for number in (300_000, 10_000_000):
        # Ten million atoms are 810 MB of text.
        body = gzip.compress(line * 10_000, 6) * (number // 10_000)
        for target in ("meshes", "estimate"):
            with Limited(binary, 4096) as server:
                begin, busy = time.monotonic(), cpu_time(server)
                response = slug(fetch(server.port, "POST", f"/v1/{target}?radius_scale=10", body, {"content-encoding": "gzip"}))
                took, busy = time.monotonic() - begin, cpu_time(server) - busy
                peak, back = server.memory("VmHWM") - server.idle, server.returned()
                measured = f"{response} in {took:.2f} s ({busy:.2f} s of processor time), {len(body) / MIB:.1f} MiB sent; peak {peak / MIB:.0f} MiB above idle"
                # 810 MB of text take longer than a second to inflate and to read. The machine may be busy.
                aim = 1 if number < 1_000_000 else 10
                reached = response.startswith(("422", "503")) and busy < aim and peak < 2048 * MIB and back is not None
                table.add(f"{number:,} identical atoms, radius_scale=10, {target}", measured, f"refused within 2 GiB and {aim} s of processor time", reached)


def named_atoms(n):
    """Returns an mmCIF file of `n` residues of one chain, with names of 255 characters, 254 of them escaped."""
    items = ("type_symbol", "label_atom_id", "label_comp_id", "auth_asym_id", "auth_seq_id", "Cartn_x", "Cartn_y", "Cartn_z")
    head = "data_x\nloop_\n" + "".join(f"_atom_site.{item}\n" for item in items)
    name = "x" + '"' * 254
    rows = (f"C C {name} {name} {i} {i % 100 * 8} {i // 100 % 100 * 8} {i // 10_000 * 8}\n" for i in range(n))
    return gzip.compress((head + "".join(rows)).encode(), 6)


def chains(n):
    """Returns an mmCIF file of `n` atoms in `n` chains."""
    head = "data_x\nloop_\n" + "".join(f"_atom_site.{item}\n" for item in ("type_symbol", "auth_asym_id", "Cartn_x", "Cartn_y", "Cartn_z"))
    rows = (f"C c{i} {i % 100 * 4} {i // 100 % 100 * 4} {i // 10_000 * 4}\n" for i in range(n))
    return gzip.compress((head + "".join(rows)).encode(), 6)


def spheres(n):
    """Returns a PQR file of `n` spheres of 50 Å on a line."""
    return gzip.compress("".join(f"ATOM 1 C ALA 1 {i / 1000} 0 0 0.0 50.0\n" for i in range(n)).encode(), 6)


def small_uploads(table, binary):
    select = "all"
    for _ in range(8):
        select = f"within 50 of ({select})"
    select = urllib.parse.quote(select)
    lattice = gzip.compress(b"1000000\n\n" + b"".join(b"C %d %d %d\n" % (4 * (i % 100), 4 * (i // 100 % 100), 4 * (i // 10_000)) for i in range(1_000_000)), 6)
    named, pockets = named_atoms(300_000), "report.json?pockets=true&resolution=3&pocket_probe"
    # Pairs at the limit take 25 s of processor time; a million atoms are also read and measured.
    attacks = [
        ("300,000 residues with names of 255 escaped characters", named, ["atoms", "areas?by=atom&surface=sas", "areas?surface=sas"], 5),
        ("1,000,000 atoms in as many chains", chains(1_000_000), ["report.json?exact=true&surface=sas&resolution=3"], 60),
        ("100,000 spheres of 50 Å", spheres(100_000), [f"{pockets}=4", f"{pockets}=20"], 25),
        ("1,000,000 atoms", lattice, [f"{pockets}=10", f"atoms?positions=true&select={select}", "areas?surface=sas"], 60),
    ]
    for name, body, targets, aim in attacks:
        for target in targets:
            with Limited(binary, 4096) as server:
                made = fetch(server.port, "POST", "/v1/structures", body, {"content-encoding": "gzip"})
                begin, busy, response = time.monotonic(), cpu_time(server), slug(made)
                if made[0] in (200, 201):
                    response = slug(fetch(server.port, "GET", f"{made[1]['location']}/{target}", timeout=300))
                took, busy, lives = time.monotonic() - begin, cpu_time(server) - busy, server.lives()
                peak = server.memory("VmHWM") - server.idle if lives else 0
                measured = f"{response} in {took:.1f} s ({busy:.1f} s of processor time), {len(body) / 1024:.0f} KiB sent; peak {peak / MIB:.0f} MiB above idle"
                reached = lives and response.startswith(("200", "422")) and busy < aim and peak < 2048 * MIB
                table.add(f"{name}, {target.partition('&')[0] if 'select' not in target else 'eight nested within'}", measured, f"result or refusal within 2 GiB and {aim} s of processor time", reached)


def json_body(table, binary):
    with Limited(binary, 512) as server:
        body = b'{"pdb_id": "4pti", "chains": [' + b"0," * 10_000_000 + b"0]}"
        begin = time.monotonic()
        response = slug(fetch(server.port, "POST", "/v1/meshes", body, {"content-type": "application/json"}))
        peak = server.memory("VmHWM") - server.idle
        measured = f"{response} in {time.monotonic() - begin:.2f} s; peak {peak / MIB:.1f} MiB above idle"
        table.add("20 MB of JSON", measured, "413 at 64 KiB", response.startswith("413") and peak < 16 * MIB)


def endless_header(table, binary):
    with Limited(binary, 512) as server:
        busy = cpu_time(server)
        with socket.create_connection(("127.0.0.1", server.port), timeout=30) as client:
            head = "POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\ncontent-type: multipart/form-data; boundary=XX\r\n"
            client.sendall(f"{head}transfer-encoding: chunked\r\n\r\n6\r\n--XX\r\n\r\n".encode())
            sent, piece = 0, b"1000\r\n" + b"x" * 0x1000 + b"\r\n"
            response = b""
            client.settimeout(0.05)
            while sent < 64 * MIB and not response:
                try:
                    client.sendall(piece)
                    sent += 0x1000
                    response = client.recv(1 << 16)
                except TimeoutError:
                    continue
                except OSError:
                    break
        busy, peak = cpu_time(server) - busy, server.memory("VmHWM") - server.idle
        code = response.split(b" ")[1].decode() if response else "closed"
        measured = f"{code} after {sent / 1024:.0f} KiB; {busy:.2f} s of processor time, peak {peak / MIB:.1f} MiB above idle"
        table.add("endless header of a form part", measured, "413 at 16 KiB", code == "413" and sent <= MIB and busy < 0.5)


def cpu_time(server):
    """Returns the processor time of the service so far, s."""
    with open(f"/proc/{server.process.pid}/stat") as stat:
        fields = stat.read().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Healthy:
    """Client on another loopback address that fetches a stored result and measures the latency."""

    def __init__(self, port, path):
        self.port, self.path, self.times, self.failed, self.over = port, path, [], 0, threading.Event()
        self.thread = threading.Thread(target=self.run)

    def run(self):
        while not self.over.wait(0.02):
            begin = time.monotonic()
            try:
                client = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60, source_address=("127.0.0.2", 0))
                client.request("GET", self.path, headers={"connection": "close"})
                response = client.getresponse()
                response.read()
                self.failed += response.status != 200
                client.close()
            except UNAVAILABLE:
                self.failed += 1
            self.times.append(time.monotonic() - begin)

    def measure(self, seconds):
        """Returns the 99th percentile of the latency, s."""
        self.times = []
        time.sleep(seconds)
        times = sorted(self.times)
        return times[len(times) * 99 // 100]


def slow_readers(table, binary, structure, seconds):
    # 60 connections of one address exceed the default share of a client, so that the attack has all addresses' share.
    with Limited(binary, 2048, ["server.client_share=1"]) as server:
        with open(structure, "rb") as file:
            made = fetch(server.port, "POST", "/v1/meshes?resolution=0.3&format=stl", file.read())
        path = made[1]["content-location"]
        while fetch(server.port, "GET", path)[0] != 200:
            time.sleep(0.1)
        healthy = Healthy(server.port, path)
        healthy.thread.start()
        alone = healthy.measure(seconds)
        files = len(os.listdir(f"/proc/{server.process.pid}/fd"))
        begin = time.monotonic()
        readers = [SlowReader(server.port, path, 64, "localhost") for _ in range(60)]
        grant, cut, most_files, held = begin + 10, None, files, 0.0
        watch = threading.Thread(target=lambda: setattr(healthy, "attacked", healthy.measure(max(seconds, 25))))
        watch.start()
        while time.monotonic() < begin + 90 and (any(reader.open for reader in readers) or watch.is_alive()):
            for reader in readers:
                reader.read()
                if reader.open and time.monotonic() > grant:
                    reader.grant()
            if time.monotonic() > grant:
                grant += 10
            if cut is None and not any(reader.open for reader in readers):
                cut = time.monotonic() - begin
            most_files = max(most_files, len(os.listdir(f"/proc/{server.process.pid}/fd")))
            held = max(held, server.metric("molmesh_memory_held_bytes"))
            time.sleep(0.5)
        watch.join()
        healthy.over.set()
        healthy.thread.join()
        peak, stalled = server.memory("VmHWM"), server.metric('molmesh_requests_rejected_total{reason="write-timeout"}')
        measured = f"{stalled:,.0f} streams cut off in {cut or 90:.0f} s; peak {peak / MIB:.0f} MiB, {held / MIB:.0f} MiB of it held; "
        measured += f"{most_files} open files ({files} before); healthy p99 {1e3 * healthy.attacked:.0f} ms, alone {1e3 * alone:.0f} ms"
        reached = cut is not None and cut < 45 and not healthy.failed and healthy.attacked < max(2 * alone, 0.1)
        table.add("60 HTTP/2 connections × 64 streams, a byte each per 10 s", measured, "cut off, healthy p99 ≤ 2 × its own", reached and server.lives())


def uploads():
    """Returns the requests of a burst: target, headers and body."""
    side = 99
    grid = pdb([(2 * x, 2 * y, 2 * z) for x in range(side) for y in range(side) for z in range(side)])
    # 79 MB of text with fewer than a million atoms, so that they are listed, and three times as much, close to
    # `limits.body_bytes`.
    large, plain = gzip.compress(grid, 1), grid * 3
    bomb = gzip.compress(b"REMARK\n" * 10_000, 9) * 8000
    form = b"\r\n".join([b"--XX", b'Content-Disposition: form-data; name="structure"; filename="a.pdb"', b"", plain, b"--XX--", b""])
    zipped, json_type = {"content-encoding": "gzip"}, {"content-type": "application/json"}
    deferred = {**zipped, "prefer": "respond-async"}
    digest = "{digest}"
    return [
        ("/v1/meshes?resolution=1&isovalue={n}", zipped, large),
        ("/v1/meshes?resolution=1.5&surface=ses&probe=1.{n3}", zipped, large),
        ("/v1/meshes?resolution=2&split=chain&color=bfactor&isovalue={n}", zipped, large),
        ("/v1/meshes?format=png&width=4096&height=4096&resolution=2&isovalue={n}", zipped, large),
        ("/v1/meshes?resolution=1.2&check=strict&isovalue={n}", {}, plain),
        ("/v1/meshes?resolution=1.1&isovalue={n}", deferred, large),
        ("/v1/meshes", {"content-type": "multipart/form-data; boundary=XX"}, form),
        ("/v1/meshes", json_type, b'{"structure": "%s", "resolution": 0.7, "isovalue": {n}}' % digest.encode()),
        ("/v1/meshes", json_type, b" " * 20_000_000),
        ("/v1/report?resolution=1&isovalue={n}", zipped, large),
        ("/v1/estimate?resolution=1&isovalue={n}", zipped, large),
        ("/v1/estimate?resolution=1", zipped, bomb),
        ("/v1/structures", zipped, large),
        ("/v1/structures", {}, plain),
        ("GET /v1/structures/{digest}/atoms", {}, b""),
        ("GET /v1/structures/{digest}/colors?scheme=chain", {}, b""),
        ("GET /v1/structures/{digest}/surface.glb?resolution=0.8&isovalue={n}", {}, b""),
        ("GET /v1/structures/{digest}/surface.png?width=4096&height=4096&isovalue={n}", {}, b""),
        ("GET /v1/pdb/1abc/surface.glb?resolution=0.8&isovalue={n}", {}, b""),
        ("GET /v1/pdb/1abc/report.json?resolution=0.9&isovalue={n}", {}, b""),
    ]


def burst(server, requests, clients):
    """Sends `clients` requests of each kind at once. Returns the responses by kind."""
    responses, lock = {}, threading.Lock()
    queue = [(kind, n) for n in range(clients) for kind in range(len(requests))]

    def client(kind, n):
        target, headers, body = requests[kind]
        method, _, path = target.rpartition(" ")
        path = path.replace("{n3}", f"{n:03}").replace("{n}", f"1.{n:03}").replace("{digest}", server.digest)
        if b"{" in body[:1]:
            body = body.replace(b"{n}", f"1.{n:03}".encode()).replace(b"{digest}", server.digest.encode())
        try:
            answer = ask(server.port, n, method or "POST", path, body, headers)
            response = slug(answer)
            if answer[0] == 503 and not answer[1].get("retry-after"):
                response = f"{response} without Retry-After"
        except UNAVAILABLE as why:
            response = f"no response: {type(why).__name__}"
        with lock:
            responses.setdefault(target, Counter())[response] += 1

    threads = [threading.Thread(target=client, args=item) for item in queue]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return responses


def ask(port, n, method, path, body, headers):
    """Sends a request from one of 100 addresses, so that no client exceeds its share. Reads the response in pieces."""
    client = http.client.HTTPConnection("127.0.0.1", port, timeout=300, source_address=(f"127.0.1.{1 + n % 100}", 0))
    try:
        try:
            client.request(method, path, body or None, {"connection": "close", **headers})
        except (BrokenPipeError, ConnectionResetError):
            # The service answered before it had read everything.
            pass
        response = client.getresponse()
        kept = b""
        while some := response.read(1 << 20):
            kept = kept or some
        return response.status, response.headers, kept
    finally:
        client.close()


def maximal_uploads(table, binary, structure, clients):
    requests = uploads()
    archive = folder()
    with open(os.path.join(archive, "1abc.pdb.gz"), "wb") as file:
        file.write(requests[0][2])
    with Limited(binary, 2048, [f"archive.dir={archive}"]) as server:
        made = fetch(server.port, "POST", "/v1/structures", requests[0][2], {"content-encoding": "gzip"})
        server.digest = json.loads(made[2])["digest"] if made[0] in (200, 201) else "0" * 64
        begin = time.monotonic()
        responses = burst(server, requests, clients)
        took = time.monotonic() - begin
        lives = server.lives()
        peak = server.memory("VmHWM") if lives else 0
        total = sum(responses.values(), Counter())
        for target, of_target in responses.items():
            print(f"  {target}: {dict(of_target)}", file=sys.stderr)
        # Requests that cannot be answered in time are refused at once, so a 504 misses the aim.
        allowed = ("200", "201", "202", "303", "413", "422 too-much-memory", "503")
        is_wrong = lambda response: not response.startswith(allowed) or response.endswith("without Retry-After")
        wrong = sum(n for response, n in total.items() if is_wrong(response))
        measured = f"{'alive' if lives else '**killed**'} after {total.total():,} requests in {took:.0f} s; peak {peak / MIB:.0f} MiB; "
        measured += ", ".join(f"{n} × {response}" for response, n in total.most_common())
        reached = lives and not wrong and peak <= 2048 * MIB
        table.add(f"{clients} maximal uploads to each of {len(requests)} targets at once, {server.group.describe()}", measured, "alive, ≤ 2 GiB; each answer a result, 413, 422 too-much-memory, or 503 with Retry-After; no 504", reached)
    # Control: the group limits the service, and the requests exceed it.
    sets = ["limits.memory_bytes=64GiB", "jobs.workers=32", f"archive.dir={archive}"]
    with Limited(binary, 1024, sets) as server:
        server.digest = "0" * 64
        burst(server, requests, min(clients, 20))
        time.sleep(1)
        table.add("control: the same with a budget of 64 GiB in 1 GiB", "alive" if server.lives() else "killed", "killed", not server.lives())


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("structure")
    parser.add_argument("--clients", type=int, default=100, help="requests to each target at once")
    parser.add_argument("--seconds", type=float, default=15, help="time to measure the healthy client alone")
    parser.add_argument("--only", nargs="+", default=("atoms", "small", "json", "header", "readers", "uploads"))
    args = parser.parse_args()
    table = Table()
    attacks = {
        "atoms": lambda: identical_atoms(table, args.binary),
        "small": lambda: small_uploads(table, args.binary),
        "json": lambda: json_body(table, args.binary),
        "header": lambda: endless_header(table, args.binary),
        "readers": lambda: slow_readers(table, args.binary, args.structure, args.seconds),
        "uploads": lambda: maximal_uploads(table, args.binary, args.structure, args.clients),
    }
    for name in args.only:
        attacks[name]()
    if table.missed:
        sys.exit(f"{table.missed} aims were missed")


if __name__ == "__main__":
    main()
