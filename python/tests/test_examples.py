"""Examples of other packages: each runs, and its assertions hold."""

import runpy
import sys

import pytest
from conftest import ROOT

EXAMPLES = sorted((ROOT / "examples/python").glob("*.py"))


def run(path, monkeypatch):
    monkeypatch.setattr(sys, "argv", [str(path)])
    runpy.run_path(str(path), run_name="__main__")


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example(path, monkeypatch, capsys):
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 40 and "assert " in text
    run(path, monkeypatch)
    assert capsys.readouterr().out


def test_a_wrong_example_fails(tmp_path, monkeypatch):
    assert len(EXAMPLES) >= 6
    path = tmp_path / "wrong.py"
    path.write_text("import molmesh\nassert molmesh.surface([[0, 0, 0]], 2, surface='vdw', resolution=1).area < 1\n")
    with pytest.raises(AssertionError):
        run(path, monkeypatch)
