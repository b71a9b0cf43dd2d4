#!/usr/bin/env python3
"""Measures the time of tiles on demand: the first tileset.json, then single tiles that are not stored.

Usage: benches/tile_latency.py BINARY STRUCTURE [QUERY] [-- SERVE_OPTION...]

Starts `BINARY serve`, uploads STRUCTURE, and requests up to 300 random tiles of each level one after the other, then up
to 600 of the last level in 6 connections, as a viewer does. Prints one line of JSON for each.
"""
import http.client
import json
import random
import re
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time


def available(subtree, levels):
    """Returns the tiles of the subtree at the root, in Morton order, as (level, x, y, z)."""
    (json_bytes,) = struct.unpack_from("<Q", subtree, 8)
    document = json.loads(subtree[24:24 + json_bytes])
    content = document["contentAvailability"][0]
    at = 24 + json_bytes
    if "bitstream" in content:
        at += document["bufferViews"][content["bitstream"]]["byteOffset"]
    tiles, first = [], 0
    for level in range(levels):
        for index in range(8**level):
            bit = first + index
            if "constant" in content or subtree[at + bit // 8] >> (bit % 8) & 1:
                axis = [sum((index >> (3 * b + k) & 1) << b for b in range(level)) for k in range(3)]
                tiles.append((level, *axis))
        first += 8**level
    return tiles


class Client:
    """Connection that is kept open."""

    def __init__(self, port):
        self.connection = http.client.HTTPConnection("127.0.0.1", port, timeout=600)

    def ask(self, method, path, body=None):
        """Returns time in ms, body and headers."""
        begun = time.perf_counter()
        self.connection.request(method, path, body)
        reply = self.connection.getresponse()
        data = reply.read()
        took = 1e3 * (time.perf_counter() - begun)
        if reply.status >= 300:
            sys.exit(f"{path}: {reply.status} {data[:300]}")
        return took, data, reply.headers


def stages(header):
    """Returns the entries of Server-Timing, ms."""
    return {name: float(ms) for name, ms in re.findall(r"(\w+);dur=([\d.]+)", header)}


def summary(label, made):
    """Prints the distribution of times, and the median of each stage, of tiles that have a surface."""
    shown = [(ms, size, times) for ms, size, times, triangles in made if triangles]
    times = sorted(ms for ms, *_ in shown)
    names = {name for *_, stage in shown for name in stage}
    medians = {name: round(statistics.median(stage.get(name, 0) for *_, stage in shown), 2) for name in sorted(names)}
    print(json.dumps({
        "tiles": label, "n": len(shown), "empty": len(made) - len(shown),
        "median_ms": round(statistics.median(times), 2), "p99_ms": round(times[int(0.99 * (len(times) - 1))], 2),
        "max_ms": round(times[-1], 2),
        "median_kb": round(statistics.median(size for _, size, _ in shown) / 1e3, 1), "stages_ms": medians,
    }), flush=True)


def main():
    end = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)
    arguments, serve = sys.argv[1:end], sys.argv[end + 1:]
    binary, structure, query = [*arguments, "resolution=0.5"][:3]
    with tempfile.TemporaryDirectory() as folder:
        command = [binary, "serve", "--listen", "127.0.0.1:0", "--data-dir", folder, *serve]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        port = None
        for line in server.stdout:
            found = re.search(r"http://127\.0\.0\.1:(\d+)", line)
            if found:
                port = int(found[1])
                break
        threading.Thread(target=lambda: [None for _ in server.stdout], daemon=True).start()
        client = Client(port)
        while True:
            client.connection.request("GET", "/readyz")
            reply = client.connection.getresponse()
            reply.read()
            if reply.status == 200:
                break
            time.sleep(0.2)
        with open(structure, "rb") as file:
            digest = json.loads(client.ask("POST", "/v1/structures", file.read())[1])["digest"]
        path = f"/v1/structures/{digest}"
        took, document, _ = client.ask("GET", f"{path}/tileset.json?{query}")
        tiling = json.loads(document)["root"]["implicitTiling"]
        print(json.dumps({"first_tileset_ms": round(took, 1), "levels": tiling["availableLevels"]}), flush=True)
        subtree = client.ask("GET", f"{path}/tileset.subtree?{query}")[1]
        tiles = available(subtree, tiling["subtreeLevels"])
        chosen = random.Random(1)

        def tile(client, address):
            address = "/".join(map(str, address))
            ms, data, headers = client.ask("GET", f"{path}/surface.glb?tile={address}&{query}&compress=meshopt")
            return ms, len(data), stages(headers["Server-Timing"]), int(headers["Molmesh-Triangles"])

        last = max(level for level, *_ in tiles)
        fresh = {level: [t for t in tiles if t[0] == level] for level in range(last + 1)}
        for level, of_level in fresh.items():
            chosen.shuffle(of_level)
            summary(f"level {level}", [tile(client, of_level.pop()) for _ in range(min(300, len(of_level) // 2 + 1))])
        made, lock = [], threading.Lock()
        rest = fresh[last][:600]

        def work():
            connection = Client(port)
            while rest:
                with lock:
                    if not rest:
                        return
                    address = rest.pop()
                made.append(tile(connection, address))

        begun = time.perf_counter()
        threads = [threading.Thread(target=work) for _ in range(6)]
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
        if made:
            summary(f"level {last}, 6 connections", made)
            print(json.dumps({"tiles_per_s": round(len(made) / (time.perf_counter() - begun), 1)}))
        server.terminate()
        server.wait()


main()
