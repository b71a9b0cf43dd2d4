"""Structures: columns, selections and assemblies."""

import gzip

import numpy as np
import pytest
from conftest import CIF, PDB

import molmesh

# Two atoms and an assembly of two copies, the second one 50 Å away.
ASSEMBLY = """\
REMARK 350 BIOMOLECULE: 1
REMARK 350 APPLY THE FOLLOWING TO CHAINS: A
REMARK 350   BIOMT1   1  1.000000  0.000000  0.000000        0.00000
REMARK 350   BIOMT2   1  0.000000  1.000000  0.000000        0.00000
REMARK 350   BIOMT3   1  0.000000  0.000000  1.000000        0.00000
REMARK 350   BIOMT1   2  1.000000  0.000000  0.000000       50.00000
REMARK 350   BIOMT2   2  0.000000  1.000000  0.000000        0.00000
REMARK 350   BIOMT3   2  0.000000  0.000000  1.000000        0.00000
ATOM      1  N   GLY A   1       0.000   0.000   0.000  1.00 10.00           N
ATOM      2  CA  GLY A   1       1.500   0.000   0.000  1.00 20.00           C
ATOM      3  C   GLY A   1       2.000   1.500   0.000  1.00 20.00           C
END
""".encode()


def atom_lines():
    return [line for line in PDB.read_text().splitlines() if line.startswith(("ATOM", "HETATM"))]


def test_the_columns_are_those_of_the_file(structure):
    lines = [line for line in atom_lines() if line.startswith("ATOM")]
    assert len(structure) == len(lines)
    columns = [(30, 38), (38, 46), (46, 54)]
    expected = np.array([[float(line[a:b]) for a, b in columns] for line in lines])
    assert structure.coordinates.dtype == np.float64
    assert np.array_equal(structure.coordinates, expected)
    assert list(structure.names) == [line[12:16].strip() for line in lines]
    assert list(structure.elements) == [line[76:78].strip() for line in lines]
    assert list(structure.chains) == [line[21] for line in lines]
    assert list(structure.residues["name"]) == [line[17:20] for line in lines]
    assert list(structure.residues["number"]) == [int(line[22:26]) for line in lines]
    assert set(structure.residues["insertion_code"]) == {""}
    assert np.allclose(structure.b_factors, [float(line[60:66]) for line in lines])
    assert structure.radii.dtype == np.float32 and set(structure.radii) == set(np.float32([1.7, 1.55, 1.52, 1.8]))
    assert list(structure.indices) == list(range(len(lines)))
    assert structure.left_out["total"] == len(atom_lines()) - len(lines)
    assert structure.warnings == [] and structure.id == "4PTI" and structure.format == "pdb"
    assert "454 atoms" in repr(structure)


def test_a_path_bytes_and_compressed_bytes_are_the_same_structure(structure, tmp_path):
    content = PDB.read_bytes()
    packed = tmp_path / "x.gz"
    packed.write_bytes(gzip.compress(content))
    sources = [str(PDB), content, bytearray(content), memoryview(content), packed, gzip.compress(content)]
    for source in sources:
        assert np.array_equal(molmesh.read(source).coordinates, structure.coordinates)


def test_selections_are_those_of_the_service():
    assert set(molmesh.read(PDB, select="name CA").names) == {"CA"}
    assert len(molmesh.read(PDB, select="all")) == len(atom_lines())
    for chains in (["A"], ("A",), np.array(["A"])):
        assert len(molmesh.read(CIF, chains=chains, model=1)) == len(molmesh.read(CIF))
    with pytest.raises(ValueError, match="did you mean `select`"):
        molmesh.read(PDB, selct="all")
    with pytest.raises(ValueError, match="unknown parameter `resolution`"):
        molmesh.read(PDB, resolution=1)


def test_formats_without_b_factors_have_none():
    assert molmesh.read(b"1\n\nC 0 0 0\n").b_factors is None


def test_charges_are_those_of_pqr():
    text = b"ATOM 1 N ALA 1 0 0 0 -0.4157 1.824\nHETATM 2 ZN ZN 2 9 0 0 2 1.1\nATOM 3 CA ALA 1 1.5 0 0 0.0337 1.908\n"
    structure = molmesh.read(text)
    assert structure.charges.dtype == np.float32 and np.allclose(structure.charges, [-0.4157, 0.0337])
    assert molmesh.read(text, select="all").charges.tolist()[1] == 2
    assert molmesh.read(PDB).charges is None and molmesh.read(CIF).charges is None


def test_an_assembly_has_the_atoms_of_all_copies():
    structure = molmesh.read(ASSEMBLY, assembly=1)
    assert list(structure.names) == ["N", "CA", "C"] * 2
    assert structure.coordinates[:, 0].tolist() == [0, 1.5, 2, 50, 51.5, 52]
    assert structure.indices.tolist() == [0, 1, 2] * 2
    for source, given in [(structure, {}), (ASSEMBLY, {"assembly": "1"})]:
        mesh = molmesh.surface(source, surface="vdw", resolution=0.4, **given)
        copy = mesh.vertices[:, 0] > 25
        assert set(mesh.atom[~copy]) == {0, 1, 2} and set(mesh.atom[copy]) == {3, 4, 5}
    # Instances have the rows of the unit.
    assert set(molmesh.surface(ASSEMBLY, assembly=1, instances=True).atom) == {0, 1, 2}


def test_the_selection_of_a_structure_is_final(structure):
    with pytest.raises(ValueError, match="`chains` cannot be set here: pass it to read"):
        molmesh.surface(structure, chains="A")
    assert molmesh.surface(structure, select=None, resolution=2).closed


def test_the_strict_validator_runs_on_request():
    assert len(molmesh.read(CIF, check="strict")) == 327
    broken = PDB.read_text().replace("ATOM     10", "ATOM     1x", 1).encode()
    with pytest.raises(molmesh.Error, match="the strict check found") as caught:
        molmesh.read(broken, check="strict")
    assert caught.value.type == "unreadable-structure"
