"""Common data of the tests."""

import os
import signal
from pathlib import Path

import pytest

import molmesh

ROOT = Path(__file__).resolve().parents[2]
PDB = ROOT / "samples/4pti.pdb"
CIF = ROOT / "samples/1crn.cif"

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
