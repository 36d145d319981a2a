"""One module per mesh-file format: `read` an open file into polygons, `encode` triangles.

The readers keep every vertex, in the file's order. They raise `MeshFileError` without the name of
the file, which `lcollision_core.files.mesh_file` adds.
"""
