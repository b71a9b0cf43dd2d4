"""Fixtures: the samples, a mesh and a service."""

import json
import os
import re
import signal
import subprocess
import sys
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
