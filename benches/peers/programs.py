#!/usr/bin/env python3
"""Prints which files programs read with the right coordinates and colours, as the rows of a table in docs/formats.md.

Usage: programs.py MOLMESH [STRUCTURE]. Tries the programs that this Python can import: trimesh, PyMeshLab, Open3D, VTK,
Blender (bpy). With Node and Chromium, tries three.js, Babylon.js and <model-viewer> as well: MOLMESH_MODULES names the
folder node_modules with three, babylonjs, babylonjs-loaders, @google/model-viewer, meshoptimizer and playwright-core,
MOLMESH_CHROMIUM the browser. Each file is read in a process of its own, which may crash.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
SAMPLE = HERE.parents[1] / "samples/1crn.cif"
# Name of each file, and the flags that make it.
FILES = {
    "plain.glb": [],
    "quantized.glb": ["--compress", "quantize"],
    "meshopt.glb": ["--compress", "meshopt"],
    "binary.ply": [],
    "text.ply": ["--format", "ply-text"],
    "mesh.obj": [],
    "mesh.stl": [],
    "mesh.vtp": [],
}


# Readers return arrays of positions and of colours, or None without colours. Colours are from 0 to 1.
def trimesh_scene(path):
    import trimesh

    mesh = trimesh.load_scene(path, process=False, skip_materials=True).to_mesh()
    return mesh.vertices, mesh.visual.vertex_colors / 255 if mesh.visual.kind == "vertex" else None


def trimesh_mesh(path):
    import trimesh

    mesh = trimesh.load(path, force="mesh", process=False)
    return mesh.vertices, mesh.visual.vertex_colors / 255 if mesh.visual.kind == "vertex" else None


def pymeshlab(path):
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(path)
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.vertex_color_matrix() if mesh.has_vertex_color() else None


def open3d(path):
    import open3d

    mesh = open3d.io.read_triangle_mesh(path)
    return mesh.vertices, mesh.vertex_colors if mesh.has_vertex_colors() else None


def vtk(path):
    import vtkmodules.all as modules
    from vtkmodules.util.numpy_support import vtk_to_numpy

    readers = {"ply": modules.vtkPLYReader, "obj": modules.vtkOBJReader, "stl": modules.vtkSTLReader, "vtp": modules.vtkXMLPolyDataReader, "glb": modules.vtkGLTFReader}
    extension = path.rpartition(".")[2]
    reader = readers[extension]()
    reader.SetFileName(path)
    reader.Update()
    data = reader.GetOutput()
    if extension == "glb":
        # Positions in the coordinates of the scene.
        parts = modules.vtkCompositeDataGeometryFilter()
        parts.SetInputConnection(reader.GetOutputPort())
        parts.Update()
        data = parts.GetOutput()
    if not data.GetNumberOfPoints():
        raise ValueError("no points")
    arrays = {data.GetPointData().GetArrayName(i): data.GetPointData().GetArray(i) for i in range(data.GetPointData().GetNumberOfArrays())}
    colors = next((vtk_to_numpy(arrays[name]) for name in ("COLOR_0", "RGBA", "RGB") if name in arrays), None)
    scale = 255 if colors is not None and colors.dtype.kind == "u" and colors.dtype.itemsize == 1 else 1
    return vtk_to_numpy(data.GetPoints().GetData()), None if colors is None else colors / scale


def blender(path):
    import bpy
    import numpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    extension = path.rpartition(".")[2]
    {"glb": bpy.ops.import_scene.gltf, "ply": bpy.ops.wm.ply_import, "obj": bpy.ops.wm.obj_import, "stl": bpy.ops.wm.stl_import}[extension](filepath=path)
    mesh = next(o for o in bpy.data.objects if o.type == "MESH")
    points = numpy.array([mesh.matrix_world @ vertex.co for vertex in mesh.data.vertices])
    layers = mesh.data.color_attributes
    if not layers:
        return points, None
    # Blender keeps colours as linear light and has written them as sRGB here.
    shown = numpy.array([item.color_srgb for item in layers[0].data])
    if layers[0].domain == "CORNER":
        by_vertex = numpy.zeros((len(points), 4))
        by_vertex[[loop.vertex_index for loop in mesh.data.loops]] = shown
        shown = by_vertex
    return points, shown


# Rows of the table: the module that must be importable, and the reader.
PROGRAMS = {
    "trimesh, `skip_materials=True`": ("trimesh", trimesh_scene),
    'trimesh, `force="mesh"`': ("trimesh", trimesh_mesh),
    "PyMeshLab": ("pymeshlab", pymeshlab),
    "Open3D": ("open3d", open3d),
    "VTK": ("vtk", vtk),
    "Blender": ("bpy", blender),
}


def linear(color):
    """Returns sRGB values as linear light."""
    import numpy

    return numpy.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def verdict(points, colors, true_points, true_colors):
    """Returns what differs from the reference, whose vertices may be in another order or repeated."""
    import numpy
    from scipy.spatial import cKDTree

    points = numpy.asarray(points, dtype=float)
    if not len(points):
        return "nothing"
    if not numpy.isfinite(points).all():
        return "**NaN coordinates**"
    moves = {
        "": points,
        "moved": points + true_points.mean(0) - points.mean(0),
        "turned": points @ numpy.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    }
    for move, moved in moves.items():
        distances, nearest = cKDTree(true_points).query(moved)
        # Half a step of quantized coordinates; 4 decimals of texts.
        if distances.max() < 0.01:
            break
    else:
        return f"other coordinates (median distance {numpy.median(distances):.3g} Å)"
    faults = [move] if move else []
    if colors is None:
        faults.append("no colours")
    else:
        colors = numpy.asarray(colors, dtype=float)[:, :3]
        # Another vertex may be the nearest if two are at nearly the same position.
        agree = lambda expected: numpy.mean(numpy.abs(colors - expected[nearest]).max(1) < 0.01) > 0.99
        if not agree(true_colors):
            faults.append("linear colours" if agree(linear(true_colors)) else "other colours")
    return ", ".join(faults) or "yes"


def read_reference(path):
    """Reads positions and colours of text PLY without a library."""
    import numpy

    text = Path(path).read_text()
    head, _, body = text.partition("end_header\n")
    n = int(re.search(r"element vertex (\d+)", head)[1])
    names = re.findall(r"property (?:float|uchar|uint) (\w+)", head)
    rows = numpy.array([line.split() for line in body.splitlines()[:n]], dtype=float)
    column = lambda *wanted: rows[:, [names.index(name) for name in wanted]]
    return column("x", "y", "z"), column("red", "green", "blue") / 255


def try_one(program, path, reference):
    """Reads a file in this process and prints the verdict."""
    points, colors = PROGRAMS[program][1](path)
    print("\n", json.dumps(verdict(points, colors, *read_reference(reference))))


def tried(program, path, reference):
    done = subprocess.run([sys.executable, __file__, "--one", program, path, reference], capture_output=True, text=True)
    # A program that has read the file may crash at its exit.
    lines = done.stdout.splitlines()
    if lines and lines[-1].startswith(' "'):
        return json.loads(lines[-1])
    return "crash" if done.returncode < 0 and "Traceback" not in done.stderr else "error"


def browser_rows(folder):
    """Returns the verdicts on GLB files by programs that need a browser."""
    import numpy

    node, modules = shutil.which("node"), os.environ.get("MOLMESH_MODULES")
    if not node or not modules:
        return {}
    done = subprocess.run([node, HERE / "programs.mjs", folder], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(done.stderr)
    reference = read_reference(folder / "text.ply")
    rows = {}
    for program, files in json.loads(done.stdout).items():
        found = {}
        for name, result in files.items():
            colors = result.get("colors")
            # These programs light with linear colours, so linear light is right for them.
            shown = None if colors is None else numpy.array(colors)[:, :3]
            words = result["error"] if "error" in result else verdict(result["points"], shown, reference[0], linear(reference[1]))
            found[name] = words
        rows[program] = found
    return rows


def main():
    if sys.argv[1:2] == ["--one"]:
        try_one(*sys.argv[2:])
        return
    molmesh, structure = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else SAMPLE
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, flags in FILES.items():
            command = [molmesh, "mesh", structure, "-o", folder / file, "--quiet", "--color", "element", "--resolution", "1", *flags]
            subprocess.run(command, check=True)
        reference = folder / "text.ply"
        rows = {}
        for program, (module, _) in PROGRAMS.items():
            if subprocess.run([sys.executable, "-c", f"import {module}"], capture_output=True).returncode == 0:
                rows[program] = {file: tried(program, str(folder / file), str(reference)) for file in FILES}
        rows |= browser_rows(folder)
    print("| |", " | ".join(f"`{file}`" for file in FILES), "|")
    print("|---" * (len(FILES) + 1) + "|")
    for program, found in rows.items():
        print(f"| {program} |", " | ".join(found.get(file, "–") for file in FILES), "|")


if __name__ == "__main__":
    main()
