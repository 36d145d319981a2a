"""Screen a folder of OBJ meshes of one topology: which intersect themselves, how deep, and where.

python screen_folder.py resources/poses -o report.csv
"""

import argparse
import csv
from pathlib import Path

import numpy as np

from lcollision_core.contact import CollisionDetector
from lcollision_core.files import read_mesh

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("folder", type=Path)
parser.add_argument("-o", "--output", type=Path, required=True)
arguments = parser.parse_args()

files = sorted(arguments.folder.glob("*.obj"))
first = read_mesh(files[0])
detector = CollisionDetector(first.topology, first.vertices)
rows = []
for path in files:
    mesh = read_mesh(path, topology=first.topology)
    collisions = detector.detect(mesh.vertices)
    depth = collisions.penetration_depth.max(initial=0.0)
    corners = mesh.vertices[mesh.topology.faces[collisions.pairs]].reshape(-1, 3)
    middle = np.round(corners.mean(axis=0), 3) if collisions.n_pairs else ()
    rows.append((path.name, collisions.n_pairs, f"{100 * depth:.3f}", *middle))
rows.sort(key=lambda row: -row[1])
with arguments.output.open("w", newline="") as file:
    table = csv.writer(file)
    table.writerow(("file", "pairs", "deepest, % of the body size", "x", "y", "z"))
    table.writerows(rows)
print(f"{sum(row[1] > 0 for row in rows)} of {len(rows)} collide; wrote {arguments.output}")
