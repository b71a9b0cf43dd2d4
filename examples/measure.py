#!/usr/bin/env python3
"""Meshes a structure and compares the measures of the service with those of trimesh.

Usage: measure.py FILE [SERVER]      (pip install requests trimesh)
"""

import io
import sys

import requests
import trimesh

file = sys.argv[1]
server = sys.argv[2] if len(sys.argv) > 2 else "http://127.0.0.1:8080"

with open(file, "rb") as structure:
    answer = requests.post(f"{server}/v1/meshes", params={"resolution": 0.5}, data=structure, timeout=60)
if not answer.ok:
    problem = answer.json()
    sys.exit(f"{problem['title']}: {problem['detail']}")

mesh = trimesh.load(io.BytesIO(answer.content), file_type="glb", force="mesh")
print(f"triangles {len(mesh.faces)}, the service says {answer.headers['molmesh-triangles']}")
print(f"closed {mesh.is_watertight}, the service says {answer.headers['molmesh-closed']}")
print(f"area {mesh.area:.1f} Å², the service says {float(answer.headers['molmesh-area']):.1f}")
print(f"volume {mesh.volume:.1f} Å³, the service says {float(answer.headers['molmesh-volume']):.1f}")
