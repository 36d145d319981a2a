"""VTK's glTF reader, a reference for the content of files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkLogger
from vtkmodules.vtkCommonDataModel import vtkCompositeDataSet, vtkPolyData
from vtkmodules.vtkIOGeometry import vtkGLTFReader


def vtk_corners(path: Path, clip: int | None = None, time: float = 0.0) -> np.ndarray:
    """Return the (3 F, 3) corners of all triangles, meshes in VTK's order.

    Parameters
    ----------
    path : a .glb or .gltf file
    clip : number of the animation; None for the stored pose
    time : in seconds
    """
    # VTK warns of material extensions.
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    reader = vtkGLTFReader()
    reader.SetFileName(str(path))
    reader.ApplyDeformationsToGeometryOn()
    reader.SetFrameRate(60)
    reader.UpdateInformation()
    for number in range(reader.GetNumberOfAnimations()):
        if number == clip:
            reader.EnableAnimation(number)
        else:
            reader.DisableAnimation(number)
    reader.UpdateInformation()
    if clip is None:
        reader.Update()
    else:
        reader.UpdateTimeStep(time)
    output = reader.GetOutputDataObject(0)
    iterator = output.NewIterator()
    found = []
    while not iterator.IsDoneWithTraversal():
        data = vtkPolyData.SafeDownCast(iterator.GetCurrentDataObject())
        assert isinstance(output, vtkCompositeDataSet)
        points = vtk_to_numpy(data.GetPoints().GetData()).astype(np.float64)
        corners = vtk_to_numpy(data.GetPolys().GetConnectivityArray())
        found.append(points[corners])
        iterator.GoToNextItem()
    return np.concatenate(found)
