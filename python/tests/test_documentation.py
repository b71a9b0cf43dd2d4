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


# Address of the service in the examples.
ADDRESS = "http://127.0.0.1:8080"


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
            for member, value in members(item).items():
                yield f"{name}.{member}", value.__doc__


def members(item):
    """Returns the public members of a class and of its bases in the package, and those that notebooks use."""
    bases = [base for base in item.__mro__ if base.__module__.startswith("molmesh")]
    found = {member: value for base in reversed(bases) for member, value in vars(base).items()}
    return {m: value for m, value in found.items() if not m.startswith("_") or m.startswith("_repr_")}


def test_everything_is_documented_and_the_examples_run(folder, service):
    total = 0
    for name, text in documented():
        assert text, name
        number, failed = run(text.replace(ADDRESS, service.url), name, folder)
        assert failed == 0, name
        total += number
    assert total > 24
    # Control: a wrong result.
    assert run(">>> 1 + 1\n3\n", "control", folder) == (1, 1)


@pytest.mark.parametrize("page, least", [("README.md", 4), ("docs/start/python.md", 40)])
def test_the_examples_of_the_pages_run(page, least, folder, service):
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^```pycon\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    number, failed = run("\n".join(blocks).replace(ADDRESS, service.url), page, folder)
    assert number >= least and failed == 0


def test_the_stubs_have_every_name():
    tree = ast.parse((ROOT / "python/molmesh/__init__.pyi").read_text())
    classes = {item.name: item for item in tree.body if isinstance(item, ast.ClassDef)}

    def fields(name):
        own = {item.target.id for item in classes[name].body if isinstance(item, ast.AnnAssign)}
        return own.union(*(fields(base.id) for base in classes[name].bases if base.id in classes))

    assert fields("_Render") == set(molmesh.PARAMETERS)
    for name in classes:
        if name.startswith("_") or name == "Error":
            continue
        nodes = classes[name].body
        stubs = {item.name for item in nodes if isinstance(item, (ast.FunctionDef, ast.AsyncFunctionDef))}
        stubs |= {item.target.id for item in nodes if isinstance(item, ast.AnnAssign)}
        assert {s for s in stubs if not s.startswith("__")} == set(members(getattr(molmesh, name))), name
    functions = {item.name for item in tree.body if isinstance(item, ast.FunctionDef)}
    assert functions == {"areas", "cavities", "pockets", "read", "render", "surface"}
    assert all(getattr(molmesh, name).__module__ == "molmesh" for name in functions)


def test_parameters_have_the_defaults_of_the_package():
    assert "Default: true." in molmesh.PARAMETERS["atom_ids"]
    assert "Default: none." in molmesh.PARAMETERS["color"]
    assert molmesh.surface([[0, 0, 0]], 2, resolution=1).atom is not None
