"""Documentation: the examples run, and the stubs list every parameter."""

import ast
import doctest
import inspect
import os
import re
import shutil

import pytest
from conftest import ROOT

import molmesh


def run(text, name, folder):
    """Runs the examples of a text in a folder with the samples. Returns their number and that of the failures."""
    test = doctest.DocTestParser().get_doctest(text, {"molmesh": molmesh}, name, name, 0)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    before = os.getcwd()
    os.chdir(folder)
    try:
        failed, number = runner.run(test, clear_globs=False)[:2]
    finally:
        os.chdir(before)
    return number, failed


@pytest.fixture
def folder(tmp_path):
    shutil.copytree(ROOT / "samples", tmp_path / "samples")
    return tmp_path


def documented():
    """Returns the documentation of the package, its functions and the members of its classes."""
    yield "molmesh", molmesh.__doc__
    for name in molmesh.__all__:
        item = getattr(molmesh, name)
        if inspect.isclass(item) or callable(item):
            yield name, item.__doc__
        if inspect.isclass(item) and item is not molmesh.Error:
            for member, value in vars(item).items():
                if not member.startswith("__"):
                    yield f"{name}.{member}", value.__doc__


def test_everything_is_documented_and_the_examples_run(folder):
    total = 0
    for name, text in documented():
        assert text, name
        number, failed = run(text, name, folder)
        assert failed == 0, name
        total += number
    assert total > 12
    # Control: a wrong result.
    assert run(">>> 1 + 1\n3\n", "control", folder) == (1, 1)


def test_the_examples_of_the_page_run(folder):
    page = (ROOT / "docs/start/python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```pycon\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    assert len(blocks) > 4
    number, failed = run("\n".join(blocks), "python.md", folder)
    assert number > 10 and failed == 0


def test_the_stubs_have_every_name():
    tree = ast.parse((ROOT / "python/molmesh/__init__.pyi").read_text())
    classes = {item.name: item for item in tree.body if isinstance(item, ast.ClassDef)}

    def fields(name):
        own = {item.target.id for item in classes[name].body if isinstance(item, ast.AnnAssign)}
        return own.union(*(fields(base.id) for base in classes[name].bases if base.id in classes))

    assert fields("_Render") == set(molmesh.PARAMETERS)
    for name in ("Structure", "Mesh"):
        stubs = {item.name for item in classes[name].body if isinstance(item, ast.FunctionDef)} - {"__len__"}
        members = {m for m in vars(getattr(molmesh, name)) if not m.startswith("__")}
        assert stubs == members, name
    functions = {item.name for item in tree.body if isinstance(item, ast.FunctionDef)}
    assert functions == {"areas", "read", "render", "surface"}
    assert all(getattr(molmesh, name).__module__ == "molmesh" for name in functions)


def test_parameters_have_the_defaults_of_the_package():
    assert "Default: true." in molmesh.PARAMETERS["atom_ids"]
    assert "Default: none." in molmesh.PARAMETERS["color"]
    assert molmesh.surface([[0, 0, 0]], 2, resolution=1).atom is not None
