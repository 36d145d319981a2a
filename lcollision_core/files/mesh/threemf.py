"""3MF for 3D printing: one solid in millimetres, in a package of three files.

It has its own writer because trimesh's needs two more packages, and its bytes differ each time.
"""

from __future__ import annotations

import io
import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt

from lcollision_core.files.mesh.text import decimals

_TYPES = """<?xml version="1.0" encoding="UTF-8"?>
<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">
<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>
<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>
</Types>
"""
_RELATIONS = """<?xml version="1.0" encoding="UTF-8"?>
<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">
<Relationship Target="/3D/3dmodel.model" Id="rel0" \
Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/>
</Relationships>
"""
_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<model unit="millimeter" xml:lang="en-US" \
xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">
<resources><object id="1" type="model"><mesh><vertices>
"""
_TAIL = """</triangles></mesh></object></resources>
<build><item objectid="1"/></build>
</model>
"""


def encode(vertices: npt.NDArray[Any], faces: npt.NDArray[np.integer]) -> bytes:
    """Write a solid as a 3MF package, each number as the shortest decimal that reads back the same.

    Parameters
    ----------
    vertices : (V, 3) float32 or float64 array, in millimetres, z up
    faces : (F, 3) integer array, indices from 0
    """
    rows = '<vertex x="%s" y="%s" z="%s"/>\n' * len(vertices) % decimals(vertices)
    named = '<triangle v1="%d" v2="%d" v3="%d"/>\n' * len(faces) % tuple(faces.ravel().tolist())
    package = io.BytesIO()
    with zipfile.ZipFile(package, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in (
            ("[Content_Types].xml", _TYPES),
            ("_rels/.rels", _RELATIONS),
            ("3D/3dmodel.model", f"{_HEAD}{rows}</vertices><triangles>\n{named}{_TAIL}"),
        ):
            # Entries opened by name have no date.
            with archive.open(name, "w") as entry:
                entry.write(text.encode("ascii"))
    return package.getvalue()
