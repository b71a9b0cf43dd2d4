"""Cluster of processes on this machine: NATS, a shared folder, and nodes with their roles. Used by the load scripts."""

import json
import os
import subprocess
import time

from mixed import UNAVAILABLE, Server, fetch, folder


class Nats:
    """NATS server with JetStream that can be killed and started again on its port."""

    def __init__(self, program, port, data, address="127.0.0.1"):
        self.command = [program, "-js", "-a", address, "-p", str(port), "-sd", data]
        self.url = f"nats://{'127.0.0.1' if address == '0.0.0.0' else address}:{port}"

    def launch(self):
        self.process = subprocess.Popen(self.command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def kill(self):
        self.process.kill()
        self.process.wait()


class Cluster:
    """NATS and nodes. `nodes` has a server for each role that was asked for."""

    def __init__(self, binary, nats, port, roles, extra=(), prefix=()):
        self.data = folder()
        self.nats = Nats(nats, port, os.path.join(self.data, "nats"))
        self.store = os.path.join(self.data, "store")
        settings = [f"broker.url={self.nats.url}", f"store.url=file://{self.store}", *extra]
        options = [option for setting in settings for option in ("--set", setting)]
        self.nodes = []
        for number, role in enumerate(roles):
            own = os.path.join(self.data, f"node{number}")
            os.makedirs(own)
            server = Server(binary, own, port + 10 + 10 * number, ["--backend", "cpu", "--role", role, *options])
            server.command = [*prefix, *server.command]
            server.role = role
            self.nodes.append(server)

    def start(self):
        """Starts everything, and waits until all nodes are ready."""
        self.nats.launch()
        for node in self.nodes:
            node.launch()
        self.ready()

    def ready(self, timeout=60):
        """Waits until all nodes are ready."""
        end = time.monotonic() + timeout
        for node in self.nodes:
            while True:
                try:
                    status, _, body = fetch(node.port, "GET", "/readyz", timeout=5)
                    if status == 200:
                        break
                except UNAVAILABLE:
                    body = b"no answer"
                if time.monotonic() > end:
                    raise SystemExit(f"a node ({node.role}) is not ready: {body.decode()}; see {node.log}")
                time.sleep(0.05)

    def of_role(self, role):
        return [node for node in self.nodes if node.role == role]

    def open_jobs(self):
        """Returns the number of records whose jobs have not ended."""
        names = set(os.listdir(os.path.join(self.store, "jobs")))
        ended = {name.removesuffix(".ended.json") for name in names if name.endswith(".ended.json")}
        return sum(name.removesuffix(".json") not in ended for name in names if name.count(".") == 1)

    def stop(self):
        """Stops everything."""
        for node in self.nodes:
            node.process.terminate()
        for node in self.nodes:
            node.process.wait()
        self.nats.kill()


def document(port, path):
    """Returns a JSON document."""
    status, _, body = fetch(port, "GET", path)
    if status != 200:
        raise SystemExit(f"GET {path}: status {status}: {body.decode()}")
    return json.loads(body)
