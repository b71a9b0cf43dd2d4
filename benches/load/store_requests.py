#!/usr/bin/env python3
"""Counts the requests of asynchronous jobs to an S3 store, on a cluster of two nodes.

    python3 benches/load/store_requests.py target/release/molmesh NATS-SERVER MOTO-SERVER samples/4pti.pdb --jobs 100
"""

import argparse
import collections
import http.client
import os
import re
import subprocess
import time

from cluster import Cluster
from mixed import fetch


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("binary")
    parser.add_argument("nats")
    parser.add_argument("moto", help="program moto_server")
    parser.add_argument("structure")
    parser.add_argument("--jobs", type=int, default=100)
    parser.add_argument("--port", type=int, default=18800)
    args = parser.parse_args()
    os.environ |= {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_REGION": "us-east-1"}
    settings = ["store.url=s3://meshes", f"store.endpoint=http://127.0.0.1:{args.port}", "store.allow_http=true"]
    cluster = Cluster(args.binary, args.nats, args.port + 10, ["api", "worker"], settings)
    log = os.path.join(cluster.data, "moto.txt")
    with open(log, "wb") as file:
        moto = subprocess.Popen([args.moto, "-p", str(args.port)], stdout=file, stderr=file)
    try:
        for _ in range(100):
            try:
                connection = http.client.HTTPConnection("127.0.0.1", args.port)
                connection.request("PUT", "/meshes")
                connection.getresponse().read()
                break
            except OSError:
                time.sleep(0.2)
        cluster.start()
        with open(args.structure, "rb") as file:
            structure = file.read()
        port = cluster.of_role("api")[0].port

        def count():
            with open(log, encoding="utf-8", errors="replace") as file:
                # The server colours the lines of some statuses.
                text = re.sub(r"\x1b\[\d+m", "", file.read())
            found = re.findall(r'"(GET|HEAD|PUT|POST|DELETE) (/meshes[^ ]*)', text)
            return collections.Counter(method for method, path in found if "/check/" not in path)

        before, jobs = count(), []
        for n in range(args.jobs):
            query = f"/v1/meshes?resolution=2&isovalue={1 + n / 1e4}"
            status, headers, _ = fetch(port, "POST", query, structure, {"prefer": "respond-async"})
            assert status == 202, status
            jobs.append(headers["location"])
        # One look at each job, as of a client that waits for its events.
        for job in jobs:
            while b'"successful"' not in fetch(port, "GET", f"{job}?wait=20")[2]:
                pass
        after = count()
        print({method: round((after[method] - before[method]) / args.jobs, 1) for method in sorted(after)}, "per job")
        cluster.stop()
    finally:
        moto.kill()


if __name__ == "__main__":
    main()
