"""The installed wheel: it needs only what it declares, and has the command molmesh with licences, service and page."""

import os
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from conftest import COMMAND, PDB

import molmesh


def run(*arguments, **options):
    """Runs a program with the packages of its own environment only, and returns what it prints."""
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(arguments, env=env, check=True, stdout=subprocess.PIPE, text=True, **options).stdout


def test_the_package_needs_only_what_it_declares():
    mesh = f"molmesh.surface({str(PDB)!r}, surface='ses', resolution=1)"
    code = f"import molmesh, numpy; molmesh.Client('http://x'); print({mesh}.closed)"
    assert run(sys.executable, "-c", code) == "True\n"
    # Control: packages of the tests are not in this environment.
    with pytest.raises(subprocess.CalledProcessError):
        run(sys.executable, "-c", "import trimesh", stderr=subprocess.DEVNULL)


def test_the_command_has_the_version_of_the_package(tmp_path):
    assert run(COMMAND, "--version").split()[:2] == ["molmesh", molmesh.__version__]
    run(COMMAND, "mesh", PDB, "-o", tmp_path / "4pti.stl", "--surface", "ses", "--resolution", "1")
    molmesh.surface(PDB, surface="ses", resolution=1).save(tmp_path / "own.stl")
    assert (tmp_path / "4pti.stl").read_bytes() == (tmp_path / "own.stl").read_bytes()


def test_the_service_has_its_page_and_draws_a_picture(service):
    with urllib.request.urlopen(service.url + "/", timeout=20) as page:
        assert "<title>" in page.read().decode()
    headers = {"Content-Type": "application/octet-stream"}
    request = urllib.request.Request(f"{service.url}/v1/meshes?format=png&width=320", PDB.read_bytes(), headers)
    with urllib.request.urlopen(request, timeout=20) as picture:
        assert picture.headers["Content-Type"] == "image/png" and picture.read(4) == b"\x89PNG"


def test_the_wheel_has_the_licences_of_its_parts():
    folder = Path(sys.prefix) / "share/doc/molmesh"
    text = (folder / "THIRD-PARTY.txt").read_text(encoding="utf-8")
    for name in ["pyo3 0.", "axum 0.", "three.js", "Swagger UI", "the Rust standard library", "Permission is hereby"]:
        assert name in text, name
    assert {path.name for path in folder.iterdir()} == {"LICENSE-MIT", "LICENSE-APACHE", "THIRD-PARTY.txt"}
