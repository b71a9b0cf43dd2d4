"""Reads VTP files with VTK as an independent check of the product's output.

Reads file names from standard input, and prints one line of JSON for each: counts, bounds, area and volume, the number
of edges that are not shared by two triangles, and the point data. A file that VTK reports an error for gives `error`.
Without VTK, prints `missing` for each file.
"""

import json
import sys

try:
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy
except ImportError:
    vtk = None


def read(path):
    """Returns the report on a file."""
    faults = []
    reader = vtk.vtkXMLPolyDataReader()
    reader.AddObserver("ErrorEvent", lambda *_: faults.append("error"))
    reader.SetFileName(path)
    reader.Update()
    if faults or reader.GetErrorCode() != 0:
        return {"error": "VTK cannot read the file"}
    mesh = reader.GetOutput()
    measures = vtk.vtkMassProperties()
    measures.SetInputData(mesh)
    measures.Update()
    edges = vtk.vtkFeatureEdges()
    edges.SetInputData(mesh)
    edges.FeatureEdgesOff()
    edges.ManifoldEdgesOff()
    edges.Update()
    low, high = mesh.GetBounds()[::2], mesh.GetBounds()[1::2]
    data = mesh.GetPointData()
    columns = {data.GetArrayName(i): vtk_to_numpy(data.GetArray(i)) for i in range(data.GetNumberOfArrays())}
    scalars = data.GetScalars()
    return {
        "points": mesh.GetNumberOfPoints(),
        "triangles": mesh.GetNumberOfPolys(),
        "bounds": [low, high],
        "area": measures.GetSurfaceArea(),
        "volume": measures.GetVolume(),
        "bad_edges": edges.GetOutput().GetNumberOfCells(),
        "scalars": scalars.GetName() if scalars else None,
        "normals": data.GetNormals() is not None,
        "colors": columns["RGBA"].tolist() if "RGBA" in columns else None,
        "atoms": columns["atom"].tolist() if "atom" in columns else None,
    }


for line in sys.stdin:
    print(json.dumps(read(line.strip()) if vtk else {"missing": True}), flush=True)
