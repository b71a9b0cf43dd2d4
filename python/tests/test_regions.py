"""Cavities and pockets, compared with closed forms and the report of a mesh."""

import math

import numpy as np
import pytest
from conftest import PDB

import molmesh

CUBE = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)])


def test_a_shell_of_spheres_has_one_cavity():
    coordinates = 3.4 * CUBE
    (cavity,) = molmesh.cavities(coordinates, 1.9)
    assert cavity.center == pytest.approx((0, 0, 0), abs=2e-3)
    assert cavity.radius == pytest.approx(3.4 - 1.9, abs=2e-3)
    assert 4 / 3 * math.pi * 1.5**3 < cavity.volume < 3.4**3 and cavity.opening_radius < 1.4
    # The probe reaches the middles of the six faces only.
    assert np.array_equal(cavity.atoms, np.flatnonzero(np.abs(CUBE).sum(axis=1) == 1))
    assert cavity.atoms.dtype == np.uint32 and not cavity.atoms.flags.writeable
    assert molmesh.cavities(coordinates, 1.9, probe=1.6) == []
    # Without the sphere of one face, it is open.
    assert molmesh.cavities(coordinates[np.any(CUBE != (1, 0, 0), axis=1)], 1.9) == []


def test_cavities_and_pockets_are_those_of_the_report(structure):
    report = molmesh.surface(PDB, surface="ses", cavities="keep", pockets=True, resolution=2).report
    cavities, pockets = molmesh.cavities(PDB), molmesh.pockets(structure)
    for found, listed in [(cavities, report["cavity_list"]), (pockets, report["pocket_list"])]:
        assert len(found) == len(listed) > 0
        for region, other in zip(found, listed):
            assert len(region.atoms) == other["atoms"] and list(region.center) == other["center"]
            for name in other.keys() - {"atoms", "center", "residues"}:
                assert getattr(region, name) == other[name], name
            residues = {(name, number) for name, number, _ in structure.residues[region.atoms].tolist()}
            assert residues == {(residue["name"], residue["number"]) for residue in other["residues"]}
    own = molmesh.pockets(structure.coordinates, structure.radii, probe=1.4, pocket_probe=4)
    assert [pocket.volume for pocket in own] == [pocket.volume for pocket in pockets]


def test_wrong_arguments_are_rejected(structure):
    for function, given, message in [
        (molmesh.cavities, {"pocket_probe": 4}, "unknown parameter `pocket_probe`"),
        (molmesh.cavities, {"resolution": 1}, "unknown parameter `resolution`"),
        (molmesh.cavities, {"model": "all"}, "`model`"),
        (molmesh.cavities, {"probe": -1}, "`probe`"),
        (molmesh.pockets, {"pocket_probe": 1}, "`pocket_probe`"),
        (molmesh.pockets, {"probe": 0.1}, "`probe`"),
    ]:
        with pytest.raises(ValueError, match=message):
            function(PDB, **given)
    with pytest.raises(ValueError, match="has selected the atoms"):
        molmesh.pockets(structure, chains="A")
    with pytest.raises(molmesh.Error) as error:
        molmesh.cavities(PDB, chains="Z")
    assert error.value.type == "empty-selection"
