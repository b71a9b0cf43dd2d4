#!/usr/bin/env python3
"""Meshes a structure and compares the measures of the service with those of trimesh.

Needs the packages requests and trimesh: pip install requests trimesh
"""

import argparse
import io
import sys

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("file", help="structure: PDB, mmCIF, BinaryCIF, PQR or XYZ")
parser.add_argument("server", nargs="?", default="http://127.0.0.1:8080", help="service (default: %(default)s)")
args = parser.parse_args()

try:
    import requests
    import trimesh
except ModuleNotFoundError as missing:
    sys.exit(f"measure.py: the package {missing.name} is not installed: pip install requests trimesh")

with open(args.file, "rb") as structure:
    response = requests.post(f"{args.server}/v1/meshes", params={"resolution": 0.5}, data=structure, timeout=60)
if not response.ok:
    problem = response.json()
    sys.exit(f"{problem['title']}: {problem['detail']}")

mesh = trimesh.load(io.BytesIO(response.content), file_type="glb", force="mesh")
print(f"triangles {len(mesh.faces)}, the service says {response.headers['molmesh-triangles']}")
print(f"closed {mesh.is_watertight}, the service says {response.headers['molmesh-closed']}")
print(f"area {mesh.area:.1f} Å², the service says {float(response.headers['molmesh-area']):.1f}")
print(f"volume {mesh.volume:.1f} Å³, the service says {float(response.headers['molmesh-volume']):.1f}")
