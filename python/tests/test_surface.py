"""Meshes: measures, arrays, files and pictures."""

import math
import os
import signal
import stat
import struct

import numpy as np
import pytest
import trimesh
from conftest import CIF, PDB

import molmesh


@pytest.mark.parametrize("kind, radius", [("vdw", 2.0), ("sas", 3.4), ("ses", 2.0)])
def test_a_sphere_has_its_area_and_volume(kind, radius):
    mesh = molmesh.surface([[10, -20, 30]], [2.0], surface=kind, resolution=0.1)
    assert mesh.area == pytest.approx(4 * math.pi * radius**2, rel=2e-3)
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * radius**3, rel=2e-3)
    distances = np.linalg.norm(mesh.vertices - [10, -20, 30], axis=1)
    assert np.allclose(distances, radius, atol=1e-3)
    outwards = (mesh.vertices - [10, -20, 30]) / distances[:, None]
    assert np.einsum("ij,ij->i", mesh.normals, outwards).min() > 0.999
    assert (mesh.components, mesh.closed, set(mesh.atom)) == (1, True, {0})
    assert mesh.report["source_format"] == "arrays"


def test_the_mesh_is_closed_and_has_the_measures_of_its_report(ses):
    solid = ses.to_trimesh()
    assert solid.is_watertight and solid.is_winding_consistent
    assert solid.area == pytest.approx(ses.area, rel=1e-5) and solid.volume == pytest.approx(ses.volume, rel=1e-5)
    assert ses.report["area"] == ses.area and ses.report["volume"] == ses.volume and ses.report["surface"] == "ses"
    assert len(ses.vertices) == ses.report["vertices"] and len(ses.faces) == ses.report["triangles"]
    assert ses.report is ses.report and "closed" in repr(ses)
    # Control: a mesh without a face is open.
    assert not trimesh.Trimesh(ses.vertices, ses.faces[1:], process=False).is_watertight


def test_own_coordinates_give_the_mesh_of_the_file(structure, ses):
    for radii in (structure.radii, structure.radii.tolist()):
        own = molmesh.surface(structure.coordinates, radii, surface="ses", resolution=0.7)
        for name in ("vertices", "faces", "normals", "atom"):
            assert np.array_equal(getattr(own, name), getattr(ses, name)), name
    again = molmesh.surface(structure, surface="ses", resolution=0.7)
    assert np.array_equal(again.vertices, ses.vertices)
    one = molmesh.surface(structure.coordinates, 1.5, resolution=np.array(2))
    equal = molmesh.surface(structure.coordinates, [1.5] * len(structure), resolution=2)
    assert np.array_equal(one.vertices, equal.vertices)


def test_own_coordinates_have_no_colours_of_a_file():
    for color in ("bfactor", "element", "chain", "hydrophobicity"):
        for function in (molmesh.surface, molmesh.render):
            with pytest.raises(ValueError, match=f"`color`: `{color}` needs a file"):
                function([[0, 0, 0]], [2], color=color)
    for color in ("uniform:#102030", "curvature", "radial"):
        assert molmesh.surface([[0, 0, 0]], [2], color=color, resolution=1).colors is not None


def test_a_trimesh_far_from_the_origin_is_closed(structure):
    mesh = molmesh.surface(structure.coordinates + 50_000, structure.radii, surface="ses", resolution=0.3)
    solid = mesh.to_trimesh()
    assert solid.vertices.dtype == np.float64 and np.abs(solid.vertices - mesh.vertices).max() < 0.0021
    assert np.array_equal(solid.vertex_attributes["atom"], mesh.atom)
    assert "atom" not in molmesh.surface(CIF, atom_ids=False, resolution=2).to_trimesh().vertex_attributes

    def is_closed(vertices):
        """Joins vertices at the same place first."""
        return trimesh.Trimesh(vertices, mesh.faces, process=True).is_watertight

    assert is_closed(solid.vertices)
    assert solid.area_faces.min() > 0
    assert solid.area == pytest.approx(mesh.area, rel=1e-5) and solid.volume == pytest.approx(mesh.volume, rel=1e-4)
    # Control: float32.
    assert len(np.unique(mesh.vertices, axis=0)) < len(np.unique(solid.vertices, axis=0)) == len(mesh.vertices)


def test_the_atom_of_a_vertex_is_the_nearest_one(structure):
    mesh = molmesh.surface(structure, surface="vdw", resolution=0.8)
    vertices = mesh.vertices[::7].astype(float)
    distances = np.linalg.norm(vertices[:, None] - structure.coordinates, axis=2) - structure.radii
    given = distances[np.arange(len(vertices)), mesh.atom[::7]]
    assert np.all(given <= distances.min(axis=1) + 1e-3)
    # Rows are those of the selection, not of the file.
    water = molmesh.read(PDB, select="water")
    assert set(molmesh.surface(water).atom) == set(range(len(water)))
    assert molmesh.surface(water, atom_ids=False).atom is None


def test_every_use_of_an_array_returns_the_same_memory(ses, structure):
    columns = [(ses, name) for name in ("vertices", "faces", "normals", "atom")]
    columns += [(structure, name) for name in ("coordinates", "radii", "names", "residues", "indices", "b_factors")]
    for owner, name in columns:
        first, second = getattr(owner, name), getattr(owner, name)
        assert first.ctypes.data == second.ctypes.data and np.shares_memory(first, second), name
        assert not first.flags.writeable and not first.flags.owndata, name
        with pytest.raises(ValueError):
            first[0] = second[1]
    assert (ses.vertices.dtype, ses.faces.dtype, ses.normals.dtype) == (np.float32, np.uint32, np.float32)
    # An array outlives the mesh.
    faces = molmesh.surface(CIF, resolution=2).faces
    assert faces.max() < len(faces)


def test_every_format_is_saved(ses, tmp_path):
    names = ["x.glb", "x.gltf", "x.ply", "x.stl", "x.obj", "x.vtp", "x.vert", "x.face", "x.png"]
    for name in names:
        ses.save(tmp_path / name)
        ses.save(str(tmp_path / name))
    ses.save(tmp_path / "text", format="ply-text")
    assert sorted(os.listdir(tmp_path)) == sorted([*names, "text"])
    assert all((tmp_path / name).stat().st_size > 1000 for name in os.listdir(tmp_path))
    for name in ("x.ply", "x.glb", "x.obj"):
        loaded = trimesh.load(tmp_path / name, force="mesh", process=False)
        assert len(loaded.faces) == len(ses.faces) and np.allclose(loaded.vertices, ses.vertices, atol=2e-4), name
    if os.name == "posix":
        mask = os.umask(0o027)
        try:
            ses.save(tmp_path / "new.stl")
        finally:
            os.umask(mask)
        assert (tmp_path / "new.stl").stat().st_mode & 0o777 == 0o640


def test_a_failed_save_leaves_no_file(ses, tmp_path):
    old = tmp_path / "x.ply"
    old.write_bytes(b"old")
    with pytest.raises(ValueError, match="ply cannot hold coordinates in meter"):
        molmesh.surface(CIF, units="meter", resolution=2).save(old)
    for name in ("x", "x.abc"):
        with pytest.raises(ValueError, match="expected one of"):
            ses.save(tmp_path / name)

    assert os.listdir(tmp_path) == ["x.ply"] and old.read_bytes() == b"old"


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="sends a signal")
def test_a_signal_ends_save_without_a_file(tmp_path):
    def stop(*_):
        raise LookupError

    old = tmp_path / "x.ply"
    old.write_bytes(b"old")
    mesh = molmesh.surface(PDB, resolution=0.15)
    before = signal.signal(signal.SIGALRM, stop)
    try:
        with pytest.raises(LookupError):
            signal.setitimer(signal.ITIMER_REAL, 0.02)
            mesh.save(old, format="obj")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    assert os.listdir(tmp_path) == ["x.ply"] and old.read_bytes() == b"old"


@pytest.mark.skipif(not os.path.exists("/dev/null"), reason="writes to a device")
def test_a_device_is_written_to_and_not_replaced(ses):
    ses.save("/dev/null", format="stl")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


def test_compressed_meshes_have_columns(tmp_path):
    plain = molmesh.surface(CIF, resolution=1)
    sizes = []
    for compress in ("none", "quantize", "meshopt"):
        mesh = molmesh.surface(CIF, resolution=1, compress=compress)
        assert np.allclose(mesh.vertices, plain.vertices, atol=2e-3)
        assert np.allclose(mesh.normals, plain.normals, atol=1e-2)
        mesh.save(tmp_path / "x.glb")
        sizes.append((tmp_path / "x.glb").stat().st_size)
        assert (b"EXT_meshopt_compression" in (tmp_path / "x.glb").read_bytes()) == (compress == "meshopt")
    assert sizes[0] > sizes[1] > sizes[2]
    with pytest.raises(ValueError, match="ply cannot hold quantized vertices"):
        mesh.save(tmp_path / "x.ply")
    assert mesh._repr_png_() is None


def test_other_parameters_belong_to_the_same_jobs():
    mesh = molmesh.surface(PDB, surface="ses", resolution=1, cavities="keep", pockets=True, exact=True, color="element")
    assert mesh.report["cavities"] >= 0 and mesh.report["pockets"] > 0
    assert mesh.report["exact"]["area"] == pytest.approx(mesh.area, rel=0.05)
    assert mesh.colors.shape == (len(mesh.vertices), 4) and mesh.colors.dtype == np.uint8
    patch = molmesh.surface(PDB, select="resi 1-5", context="whole", resolution=1)
    assert not patch.closed and patch.volume is None
    selected = patch.atom < len(molmesh.read(PDB, select="resi 1-5"))
    assert selected.any() and set(patch.atom[~selected]) <= {2**32 - 1}
    expected = molmesh.surface(CIF, max_triangles=3000, color="bfactor", color_range="0,20")
    assert 0 < len(expected.faces) <= 3000
    for color_range in [(0, 20), np.array([0, 20]), np.array([0.0, 20.0])]:
        reduced = molmesh.surface(CIF, max_triangles=np.int64(3000), color="bfactor", color_range=color_range)
        assert np.array_equal(reduced.colors, expected.colors)


def test_pictures(ses):
    def size(png):
        assert png[:8] == b"\x89PNG\r\n\x1a\n"
        return struct.unpack(">II", png[16:24])

    assert size(ses._repr_png_()) == (512, 512)
    assert size(molmesh.render(ses, width=64, height=48, background="white")) == (64, 48)
    direct = molmesh.render(PDB, surface="ses", resolution=0.7, width=64, height=48, background="white")
    assert direct == molmesh.render(ses, width=64, height=48, background="white")
    assert size(molmesh.render([[0, 0, 0]], [1.5], width=16, height=16)) == (16, 16)
    with pytest.raises(ValueError, match="unknown parameter `resolution`"):
        molmesh.render(ses, resolution=1)
    with pytest.raises(ValueError, match="`width`"):
        molmesh.surface(PDB, width=64)


def test_a_map_colours_the_surface():
    grid = np.linspace(-1, 1, 8)
    lines = ["object 1 class gridpositions counts 2 2 2", "origin -10 -10 -10", "delta 20 0 0", "delta 0 20 0"]
    lines += ["delta 0 0 20", "object 2 class gridconnections counts 2 2 2"]
    lines += ["object 3 class array type double rank 0 items 8 data follows", " ".join(map(str, grid))]
    dx = "\n".join([*lines, ""]).encode()
    mesh = molmesh.surface([[0, 0, 0]], [1.5], color="map", map=dx, resolution=0.3)
    assert len(np.unique(mesh.colors, axis=0)) > 10
    with pytest.raises(ValueError):
        molmesh.surface([[0, 0, 0]], [1.5], map=dx)

