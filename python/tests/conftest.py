"""Fixtures: the samples, a mesh, a service and a server that fails."""

import http.server
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import pytest

import molmesh

ROOT = Path(__file__).resolve().parents[2]
PDB = ROOT / "samples/4pti.pdb"
CIF = ROOT / "samples/1crn.cif"
# The wheel brings the command.
COMMAND = Path(sys.executable).parent / "molmesh"

# A job of many seconds.
LONG = {"surface": "ses", "resolution": 0.04, "quality": "high"}

# A shell lets its background processes ignore the signal, and Python then has no handler for it.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def in_root():
    """Runs the tests in the root of the repository, as the examples expect."""
    before = os.getcwd()
    os.chdir(ROOT)
    yield
    os.chdir(before)


@pytest.fixture(scope="session")
def structure():
    return molmesh.read(PDB)


@pytest.fixture(scope="session")
def ses():
    return molmesh.surface(PDB, surface="ses", resolution=0.7)


class Service:
    """Service that can be killed and started again on its port with its data."""

    def __init__(self, folder, *options):
        self.folder, self.options, self.port, self.process = folder, options, 0, None
        self.start()

    @property
    def url(self):
        return f"http://127.0.0.1:{self.port}"

    def start(self):
        log = self.folder / "log"
        command = [COMMAND, "serve", "--listen", f"127.0.0.1:{self.port}", "--data-dir", self.folder / "data"]
        command += ["--log", "json", "--backend", "cpu", "--archive", ROOT / "samples", "--set", "archive.url=none"]
        # Ctrl-C of a test is not for the service.
        with open(log, "wb") as output:
            outputs = {"stdout": output, "stderr": output}
            self.process = subprocess.Popen([*command, *self.options], **outputs, start_new_session=True)
        end = time.monotonic() + 60
        while not self.is_ready(log.read_text()):
            assert self.process.poll() is None and time.monotonic() < end, log.read_text()
            time.sleep(0.02)

    def is_ready(self, log):
        if found := re.search(r'"address":"127.0.0.1:(\d+)"', log):
            self.port = int(found[1])
            try:
                return urllib.request.urlopen(f"{self.url}/readyz", timeout=5).status == 200
            except OSError:
                pass
        return False

    def kill(self):
        self.process.kill()
        self.process.wait()

    def jobs(self):
        """Returns the records of jobs by id."""
        files = (self.folder / "data/store/jobs").glob("*.json")
        return {file.name.partition(".")[0]: json.loads(file.read_text()) for file in files}


@pytest.fixture(scope="session")
def service(tmp_path_factory):
    service = Service(tmp_path_factory.mktemp("service"))
    yield service
    service.kill()


@pytest.fixture
def client(service):
    with molmesh.Client(service.url) as client:
        yield client


class FailingServer:
    """Server whose responses a function determines, with the method, the path and the number of the request. `after` is
    called with the path after the content of a response.
    """

    def __init__(self, answer, after=lambda path: None):
        self.n_requests, self.headers, lock = 0, [], threading.Lock()

        class Handler(http.server.BaseHTTPRequestHandler):
            def work(handler):
                with lock:
                    number, self.n_requests = self.n_requests, self.n_requests + 1
                    self.headers.append(handler.headers)
                handler.rfile.read(int(handler.headers.get("Content-Length", 0)))
                status, headers, content = answer(handler.command, handler.path, number)
                handler.send_response(status)
                for name, value in {"Content-Length": str(len(content)), **headers}.items():
                    handler.send_header(name, value)
                handler.end_headers()
                handler.wfile.write(content)
                after(handler.path)

            do_GET = do_POST = do_DELETE = work

            def log_message(self, *_):
                """Prints nothing."""

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.server.shutdown()
        self.server.server_close()


def problem(kind, status, headers=None, **members):
    document = {"type": f"/problems/{kind}", "title": "t", "status": status, "detail": "d", "instance": "i", **members}
    return status, headers or {}, json.dumps(document).encode()


def variants(folder, number):
    """Writes structures with different digests."""
    for n in range(number):
        (folder / f"{n}.pdb").write_bytes(PDB.read_bytes() + b"REMARK %d\n" % n)
    return sorted(folder.glob("*.pdb"))


def caught(function, *args, **given):
    with pytest.raises(molmesh.Error) as error:
        function(*args, **given)
    return error.value
