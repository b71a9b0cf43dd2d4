"""Errors: types, fields, and no panic for any input."""

import errno
import pickle
import random

import numpy as np
import pytest
from conftest import CIF, PDB

import molmesh

EXPECTED = (molmesh.Error, ValueError, TypeError, OverflowError, OSError)


@pytest.mark.parametrize(
    "coordinates, radii, message",
    [
        ([[0, 0, 0]], [[1]], r"radii have shape \[1, 1\], expected \(1,\)"),
        ([[0, 0, 0]], [1, 2], r"radii have shape \[2\]"),
        ([[0, 0, 0]], [1e8], "the radius 100000000 Å is too large"),
        ([[0, 0]], [1], r"coordinates have shape \[1, 2\], expected \(n, 3\)"),
        ([0, 0, 0], [1], r"coordinates have shape \[3\]"),
        (np.zeros((0, 3)), [], "no coordinates"),
        ([[0, float("nan"), 0]], [1], "sphere 0: y is NaN"),
        ([[0, 0, 0], [1, 1, 1e9]], [1, 1], "sphere 1: z is 1000000000"),
        ([[0, 0, 0]], [-1], "sphere 0: radius is -1"),
        ([[0, 0, 0]], [0], "sphere 0: radius is 0"),
        ([[0, 0, 0]], [float("inf")], "sphere 0: radius is inf"),
        ([["a", "b", "c"]], [1], "could not convert"),
        ([[0, 0, 0]], None, "radii are missing: expected coordinates and radii"),
        (np.ma.masked_greater([[0, 0, 1]], 0), [1], "coordinates have masked values"),
        ([[0, 0, 0]], np.ma.masked_greater([1], 0), "radii have masked values"),
        (str(PDB), [1], "radii belong to an array"),
    ],
)
def test_bad_arrays_are_value_errors(coordinates, radii, message):
    for function in (molmesh.surface, lambda *a: molmesh.areas(*a, surface="sas"), molmesh.render):
        with pytest.raises(ValueError, match=message):
            function(coordinates, radii)


def test_numbers_of_other_types_are_type_errors():
    zero = [[0, 0, 0]]
    times = np.array([1], "m8[s]")
    for coordinates, radii in [(np.array(zero, complex), [1]), (zero, np.ones(1, complex)), (zero, times)]:
        with pytest.raises(TypeError, match="expected real numbers"):
            molmesh.surface(coordinates, radii)
    for kind in (np.int8, np.float16, ">f8", object):
        assert molmesh.surface(np.array(zero, kind), np.array([2], kind), resolution=1).closed


def test_the_number_of_atoms_is_checked_before_arrays_are_copied():
    for kind in (float, np.int8):
        coordinates = np.broadcast_to(np.zeros(3, kind), (10**8, 3))
        for radii in (np.broadcast_to(np.ones(1), 10**8), 1.5):
            with pytest.raises(molmesh.Error, match="atoms") as error:
                molmesh.surface(coordinates, radii)
            assert error.value.limit == 20_000_000


def test_read_takes_files_only(structure):
    for source in (structure, structure.coordinates, [[0, 0, 0]], 3, None):
        with pytest.raises(TypeError, match="expected a path or bytes"):
            molmesh.read(source)


def test_bad_parameters_are_value_errors():
    for given, message in [
        ({"resolutoin": 1}, "unknown parameter `resolutoin`; did you mean `resolution`"),
        ({"resolution": 0}, "`resolution`"),
        ({"resolution": float("nan")}, "`resolution`"),
        ({"resolution": "fine"}, "`resolution`: `fine` is not allowed"),
        ({"resolution": 1, "detail": 2}, "only one of"),
        ({"surface": "msms"}, "`surface`"),
        ({"select": "protein and"}, "character 12"),
        ({"color": "map"}, "map"),
        ({"format": "ply"}, "save"),
        ({"split": "entity"}, "`split`"),
    ]:
        with pytest.raises(ValueError, match=message):
            molmesh.surface(PDB, **given)
    for wrong in (3, None, object()):
        with pytest.raises(TypeError, match="expected a path, bytes"):
            molmesh.surface(wrong)
    with pytest.raises(TypeError):
        molmesh.surface(PDB, map=3)


def test_errors_have_the_names_of_the_service():
    def caught(function, *args, **given):
        with pytest.raises(molmesh.Error) as error:
            function(*args, **given)
        return error.value

    assert caught(molmesh.read, b"no structure").type == "unreadable-structure"
    broken = PDB.read_text().replace(" 26.465 ", " 26.4x5 ", 1).encode()
    syntax = caught(molmesh.read, broken)
    assert syntax.type == "unreadable-structure" and syntax.line > 1 and syntax.column > 1
    chain = caught(molmesh.read, PDB, chains="Z")
    assert (chain.type, chain.value, chain.limit) == ("empty-selection", "Z", None)
    assert caught(molmesh.surface, PDB, isovalue=1000).type == "no-surface"
    far = [[0, 0, 0], [90000, 90000, 90000]]
    large = caught(molmesh.surface, far, [5000, 5000], surface="vdw", resolution=0.1)
    assert large.type == "too-many-candidates" and large.limit > 0 and large.suggested_resolution > 0.1
    copy = pickle.loads(pickle.dumps(large))
    assert (copy.type, copy.limit, str(copy)) == (large.type, large.limit, str(large))


def test_files_that_cannot_be_opened_are_os_errors(tmp_path):
    with pytest.raises(FileNotFoundError) as error:
        molmesh.read(tmp_path / "none.pdb")
    assert error.value.filename == str(tmp_path / "none.pdb")
    with pytest.raises(OSError):
        molmesh.read(tmp_path)


def test_files_that_cannot_be_written_are_os_errors(ses, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    for path, number in [("no/x.ply", errno.ENOENT), ("file/x.ply", errno.ENOTDIR), ("", errno.EISDIR)]:
        path = tmp_path / path
        with pytest.raises(OSError) as error:
            ses.save(path, format="ply")
        assert (error.value.errno, error.value.filename) == (number, str(path))
        assert ".part" not in str(error.value)


def test_no_input_causes_a_panic():
    random.seed(4)
    content = PDB.read_bytes()[:20000]
    values = [0, -1, 1e300, float("nan"), "", "\x00", "é" * 5000, "A,B", [], [1, [2]], {"a": 1}, b"x", True, "\ud800"]
    recursive = []
    recursive.append(recursive)
    values += [recursive, np.array(3), np.array([[1, 2]]), np.array(["A"]), np.array([0, 20])]
    for n in range(200):
        given = {random.choice(list(molmesh.PARAMETERS)): random.choice(values), "resolution": 3}
        cut = random.randrange(len(content))
        noise = bytearray(content[cut : cut + random.randrange(2000)])
        if noise:
            noise[random.randrange(len(noise))] = random.randrange(256)
        source = [bytes(noise), CIF, [[0, 0, 0]] * (n % 3)][n % 3]
        for function in (molmesh.surface, molmesh.areas, molmesh.render):
            try:
                function(source, *([[1.0] * (n % 3)] if n % 3 == 2 else []), **given)
            except EXPECTED:
                pass


def test_nested_lists_are_errors():
    recursive, deep = [], []
    recursive.append(recursive)
    for _ in range(100_000):
        deep = [deep]
    for value in (recursive, deep):
        with pytest.raises((ValueError, RecursionError, molmesh.Error)):
            molmesh.surface(CIF, chains=value)
        with pytest.raises((ValueError, RecursionError)):
            molmesh.surface(CIF, color_range=value)
    # Not with `del`, which would recurse in some versions of Python.
    while deep:
        deep = deep[0]
