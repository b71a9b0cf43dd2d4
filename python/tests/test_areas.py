"""Exact areas, compared with closed forms and freesasa."""

import math

import freesasa
import numpy as np
import pytest
from conftest import PDB

import molmesh


def test_two_spheres_have_their_closed_form():
    r, d, probe = 2.0, 2.5, 1.4
    for kind, radius in [("vdw", r), ("sas", r + probe)]:
        cap = 2 * math.pi * radius * (radius - d / 2)
        table = molmesh.areas([[0, 0, 0], [d, 0, 0]], [r, r], surface=kind)
        assert list(table) == ["area"]
        assert np.allclose(table["area"], 4 * math.pi * radius**2 - cap, rtol=1e-7)


def test_areas_of_atoms_agree_with_freesasa(structure):
    table = molmesh.areas(structure, surface="sas", by="atom")
    parameters = freesasa.Parameters({"algorithm": freesasa.LeeRichards, "n-slices": 200, "probe-radius": 1.4})
    other = freesasa.calcCoord(structure.coordinates.ravel(), structure.radii.astype(float), parameters)
    expected = np.array([other.atomArea(i) for i in range(len(structure))])
    assert table["area"].sum() == pytest.approx(expected.sum(), rel=1e-3)
    assert np.abs(table["area"] - expected).max() < 0.2
    assert np.array_equal(table["name"], structure.names) and np.array_equal(table["index"], structure.indices)
    assert table["index"].dtype == structure.indices.dtype == np.uint32
    own = molmesh.areas(structure.coordinates, structure.radii, surface="sas")
    assert np.array_equal(own["area"], table["area"])


@pytest.mark.parametrize("kind", ["vdw", "sas", "ses"])
def test_levels_have_equal_sums(kind, structure):
    tables = {by: molmesh.areas(PDB, surface=kind, by=by) for by in ("atom", "residue", "chain")}
    exact = molmesh.surface(structure, surface=kind, exact=True, resolution=2).report["exact"]["area"]
    for table in tables.values():
        assert table["area"].sum() == pytest.approx(exact, abs=1e-3)
    assert [len(table["area"]) for table in tables.values()] == [454, 58, 1]
    assert list(tables["chain"])[:4] == ["chain", "model", "atoms", "area"]
    assert tables["residue"]["residue_name"][0] == "ARG" and tables["residue"]["residue_number"][-1] == 58
    assert ("contact" in tables["atom"]) == (kind == "ses")
    if kind == "ses":
        parts = [tables["residue"][name] for name in ("contact", "toroidal", "concave")]
        assert np.allclose(sum(parts), tables["residue"]["area"])


def test_interfaces_have_buried_areas():
    lines = [line for line in PDB.read_text().splitlines() if line.startswith("ATOM")]
    moved = [f"{line[:21]}B{line[22:30]}{float(line[30:38]) + 25:8.3f}{line[38:]}" for line in lines]
    table = molmesh.areas("\n".join(lines + moved).encode(), surface="sas", by="chain", interface=["A", "B"])
    assert list(table["chain"]) == ["A", "B"] and (table["buried"] > 0).all()
    assert np.allclose(table["alone"] - table["area"], table["buried"])


def test_wrong_arguments_are_rejected(structure):
    for given in [{}, {"surface": "gaussian"}, {"surface": "sas", "by": "model"}, {"surface": "sas", "resolution": 1}]:
        with pytest.raises(ValueError):
            molmesh.areas(structure, **given)
    with pytest.raises(ValueError, match="`by` needs residues"):
        molmesh.areas([[0, 0, 0]], [1], surface="sas", by="chain")
