#!/usr/bin/env python3
"""Measures one large mesh on clusters of one to several workers, which share it in partitions.

    python3 benches/load/cluster_large.py target/release/molmesh NATS-SERVER 2btv.pdb.gz \\
        --parameters 'assembly=1&resolution=1&format=ply'

Each worker has `--threads` threads, so the workers need as many cores. Prints the time from the request to the result,
and the partitions. All results must be equal.
"""

import argparse
import hashlib
import os
import time

from cluster import Cluster
from mixed import fetch


def peak(node):
    """Returns the peak memory of a node, bytes."""
    with open(f"/proc/{node.process.pid}/status") as file:
        return next(1024 * int(line.split()[1]) for line in file if line.startswith("VmHWM:"))


def measure(args, structure, workers):
    """Meshes the structure, prints what it took, and returns the digest of the mesh."""
    settings = ["jobs.workers=1", f"broker.partition_ms={args.partition_ms}", *args.set]
    cluster = Cluster(args.binary, args.nats, args.port + 100 * workers, ["api"] + workers * ["worker"], settings)
    cluster.start()
    port, begun = cluster.of_role("api")[0].port, time.perf_counter()
    status, headers, body = fetch(port, "POST", f"/v1/meshes?{args.parameters}", structure, {"prefer": "respond-async"})
    assert status == 202, body
    while b'"successful"' not in (document := fetch(port, "GET", headers["location"] + "?wait=20", timeout=60)[2]):
        assert b'"accepted"' in document or b'"running"' in document, document
    seconds = time.perf_counter() - begun
    results = os.path.join(cluster.store, "results")
    files = [os.path.join(root, name) for root, _, names in os.walk(results) for name in names]
    mesh = max(files, key=os.path.getsize)
    others = [os.path.getsize(file) for file in files if file.endswith(".partition")]
    peaks = [peak(node) for node in cluster.of_role("worker")]
    with open(mesh, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    print(
        f"{workers} workers: {seconds:.1f} s, mesh {os.path.getsize(mesh) / 1e6:.0f} MB; "
        f"{len(others)} partitions of other workers, {sum(others) / 1e6:.0f} MB; peak memory {', '.join(f'{bytes / 1e6:.0f}' for bytes in peaks)} MB",
        flush=True,
    )
    cluster.stop()
    return digest


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("nats")
    parser.add_argument("structure")
    parser.add_argument("--parameters", default="resolution=0.5&format=ply")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--threads", type=int, default=1, help="threads of each worker")
    parser.add_argument("--partition-ms", type=int, default=2000)
    parser.add_argument("--set", action="append", default=[], help="more settings of the nodes")
    parser.add_argument("--port", type=int, default=18900)
    args = parser.parse_args()
    os.environ["RAYON_NUM_THREADS"] = str(args.threads)
    with open(args.structure, "rb") as file:
        structure = file.read()
    digests = {measure(args, structure, workers) for workers in args.workers}
    assert len(digests) == 1, digests


if __name__ == "__main__":
    main()
