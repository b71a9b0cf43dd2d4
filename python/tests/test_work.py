"""Threads, signals, progress and forks."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from conftest import CIF, PDB

import molmesh

# A job of seconds.
LONG = {"surface": "ses", "resolution": 0.05}


def test_calls_run_at_the_same_time_in_threads():
    expected = molmesh.surface(CIF, resolution=0.8).vertices
    with ThreadPoolExecutor(4) as pool:
        for mesh in pool.map(lambda _: molmesh.surface(CIF, resolution=0.8), range(12)):
            assert np.array_equal(mesh.vertices, expected)


def test_other_threads_run_during_a_call():
    done = threading.Event()

    def work():
        molmesh.surface(PDB, surface="ses", resolution=0.15)
        done.set()

    thread = threading.Thread(target=work)
    thread.start()
    turns = 0
    while not done.is_set():
        time.sleep(0.001)
        turns += 1
    thread.join()
    # A call that holds the interpreter lock leaves a turn or two, before and after it.
    assert turns > 10


@pytest.mark.skipif(os.name != "posix", reason="sends a signal")
def test_ctrl_c_ends_a_call_soon():
    delays = []
    for _ in range(3):
        sent = []

        def interrupt():
            sent.append(time.monotonic())
            os.kill(os.getpid(), signal.SIGINT)

        threading.Timer(0.1, interrupt).start()
        with pytest.raises(KeyboardInterrupt):
            molmesh.surface(PDB, **LONG)
        delays.append(time.monotonic() - sent[0])
    assert min(delays) < 0.1, delays


def test_progress_grows_to_one():
    seen = []
    molmesh.surface(PDB, surface="ses", resolution=0.15, progress=lambda stage, part: seen.append((stage, part)))
    stages, parts = zip(*seen)
    assert len(seen) > 2 and all(isinstance(stage, str) for stage in stages)
    assert list(parts) == sorted(parts) and parts[-1] == 1.0


def test_the_picture_of_a_mesh_has_its_stages():
    seen = []
    mesh = molmesh.surface(CIF, resolution=1)
    molmesh.render(mesh, width=1024, height=1024, progress=lambda stage, part: seen.append((stage, part)))
    assert {stage for stage, _ in seen} <= {"draw", "png"} and seen[-1][1] == 1.0


def test_an_exception_of_progress_ends_the_call():
    def stop(stage, part):
        raise LookupError(stage)

    start = time.monotonic()
    with pytest.raises(LookupError):
        molmesh.surface(PDB, progress=stop, **LONG)
    assert time.monotonic() - start < 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_fork_after_use_is_an_error():
    script = f"""
import os, molmesh
before = os.fork()
if before:
    assert os.waitpid(before, 0)[1] == 0
    molmesh.read({str(CIF)!r})
    after = os.fork()
    if after:
        assert os.waitpid(after, 0)[1] == 0
    else:
        try:
            molmesh.read({str(CIF)!r})
        except RuntimeError as error:
            assert "forked" in str(error)
            os._exit(0)
        os._exit(1)
else:
    molmesh.read({str(CIF)!r})
    os._exit(0)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)
