"""Meshes a structure file with numba and the flying edges of VTK: `vtk_peer.py IN OUT SPACING` writes PLY."""

import sys

from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkImageData
from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

import field
import ply

source, target, spacing = sys.argv[1], sys.argv[2], float(sys.argv[3])
density, origin = field.dense(*field.read(source), spacing)
image = vtkImageData()
# The x axis of VTK is the fastest in memory, which is our z axis.
image.SetDimensions(*density.shape[::-1])
image.SetSpacing(spacing, spacing, spacing)
image.SetOrigin(*origin[::-1])
image.GetPointData().SetScalars(numpy_to_vtk(density.ravel()))
edges = vtkFlyingEdges3D()
edges.SetInputData(image)
edges.SetValue(0, 1.0)
edges.ComputeNormalsOn()
edges.ComputeGradientsOff()
edges.ComputeScalarsOff()
edges.Update()
mesh = edges.GetOutput()
faces = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3)
vertices = vtk_to_numpy(mesh.GetPoints().GetData())
normals = vtk_to_numpy(mesh.GetPointData().GetNormals())
# Restore our order of axes. This mirrors the mesh, so the corners are reversed, too.
ply.write(target, vertices[:, ::-1], faces[:, ::-1], normals[:, ::-1])
