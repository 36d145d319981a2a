"""Check meshes of a body for self-collisions, and write the nearest ones without.

python check_and_resolve.py body resources/poses/windmill.obj -o free
"""

import argparse
from pathlib import Path

from lcollision_core.bodies import encode_mesh, export_mesh, open_body, read_model_mesh

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("model", help="a model's name, or a rigged character's file")
parser.add_argument("meshes", nargs="+", type=Path)
parser.add_argument("-o", "--output", type=Path, required=True)
arguments = parser.parse_args()

model = open_body(arguments.model)
arguments.output.mkdir(parents=True, exist_ok=True)
for path in arguments.meshes:
    mesh = read_model_mesh(path, model)
    collisions = model.detector.detect(mesh.vertices)
    if not collisions.n_pairs:
        print(f"{path}: no collisions")
        continue
    pose = encode_mesh(mesh, model)
    result = model.resolve(pose.latent, placement=pose.placement)
    print(
        f"{path}: {collisions.n_pairs} pairs of faces collided, "
        f"{result.pairs_after} do now; moved by {100 * result.vertex_distance_mean:.2f} %"
    )
    export_mesh(arguments.output / path.name, model, result.vertices, pose.placement)
