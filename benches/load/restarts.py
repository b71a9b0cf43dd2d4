#!/usr/bin/env python3
"""Checks that restarts under mixed load lose no jobs and return no wrong bytes.

    python3 benches/load/restarts.py target/release/molmesh samples/4pti.pdb samples/1crn.cif --seconds 60 --every 10

The clients request meshes, start and cancel jobs, upload structures, and read results in ranges. They retry while the
service is stopped or asks them to. Each response is compared with the output of `molmesh mesh` for the same input. The
service is stopped with SIGTERM under load and restarted after it has ended. The exit code is 1 if anything is wrong.
"""

import argparse
import sys
import time
from statistics import median

from mixed import Expected, Load, Server, folder


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("structures", nargs="+")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--every", type=float, default=10)
    parser.add_argument("--clients", type=int, default=12)
    parser.add_argument("--port", type=int, default=18480)
    args = parser.parse_args()
    server = Server(args.binary, folder(), args.port, ["--backend", "cpu"])
    load = Load(args.port, Expected(args.binary, args.structures), args.clients)
    server.start()
    load.start()
    end, stops, starts, codes = time.monotonic() + args.seconds, [], [], []
    while time.monotonic() < end:
        time.sleep(args.every)
        code, took = server.stop()
        codes.append(code)
        stops.append(took)
        starts.append(server.start())
    load.finish()
    load.follow_deferred()
    code, took = server.stop()
    codes.append(code)
    stops.append(took)
    print(load.report())
    print(f"stops: {len(stops)}, exit codes {sorted(set(codes))}, median {median(stops):.2f} s, longest {max(stops):.2f} s")
    print(f"ready again: median {median(starts):.3f} s, longest {max(starts):.3f} s")
    if load.bad() or any(codes):
        sys.exit("errors occurred: see above")


main()
