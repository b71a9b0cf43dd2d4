"""Reads mesh files with trimesh as an independent check of the product's output.

Reads file names from the arguments, or one per line from standard input, and prints one line of JSON for each at
once, so a test can keep the process running. Nothing is repaired. Only STL files, which have no shared vertices, are
welded where coordinates are equal; then `welded` is true. A file that cannot be read gives `error`. Node transforms
of glTF are applied.
"""

import json
import sys

import numpy as np
import trimesh


def load(path):
    """Returns the file as one mesh in its own coordinates, and its stored vertex normals or None."""
    options = {"process": False, "maintain_order": True} if path.endswith(".obj") else {"process": False}
    scene = trimesh.load_scene(path, **options)
    parts, normals = [], []
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name].copy(include_cache=True)
        written = part._cache.cache.get("vertex_normals")
        if written is not None:
            # Row vectors times the inverse equal column vectors times its transpose. A scale does not stretch them.
            linear = transform[:3, :3] / np.cbrt(np.linalg.det(transform[:3, :3]))
            normals.append(np.array(written, dtype=np.float64) / normal_unit(path) @ np.linalg.inv(linear))
        part.apply_transform(transform)
        parts.append(part)
    if not parts:
        return trimesh.Trimesh(process=False), None, []
    mesh = parts[0] if len(parts) == 1 else trimesh.util.concatenate(parts)
    return mesh, np.concatenate(normals) if len(normals) == len(parts) else None, parts


def normal_unit(path):
    """Returns the integer that represents 1 in the normals of a glTF, since trimesh returns integers unscaled."""
    if not path.endswith((".glb", ".gltf")):
        return 1.0
    with open(path, "rb") as file:
        data = file.read()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")] if path.endswith(".glb") else data)
    attributes = document["meshes"][0]["primitives"][0]["attributes"]
    accessor = document["accessors"][attributes["NORMAL"]]
    # 5120 is the component type of a signed byte.
    return 127.0 if accessor["componentType"] == 5120 and accessor.get("normalized") else 1.0


def weld(mesh):
    """Merges vertices with equal coordinates."""
    vertices = np.ascontiguousarray(mesh.vertices) + 0.0  # -0 is 0
    rows = vertices.view(np.dtype((np.void, vertices.dtype.itemsize * 3))).ravel()
    _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
    return trimesh.Trimesh(vertices[first], inverse.reshape(-1)[mesh.faces], process=False)


def stl_normals(path):
    """Returns the stored normals, which trimesh otherwise replaces by its own."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.fromfile(path, dtype=record, offset=84)["normal"].astype(np.float64)


def normal_report(mesh, normals):
    """Returns the largest deviation of stored normals from length 1 and their agreement with the adjacent faces."""
    lengths = np.linalg.norm(normals, axis=1)
    corners = mesh.vertices[mesh.faces]
    # The length of the cross product is twice the area, so the sum over the faces of a vertex is weighted by area.
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mean = np.stack(
        [np.bincount(mesh.faces.ravel(), np.repeat(crosses[:, k], 3), len(mesh.vertices)) for k in range(3)], axis=1
    )
    size = np.linalg.norm(mean, axis=1)
    used = size > 0
    dots = np.einsum("ij,ij->i", normals[used], mean[used]) / size[used]
    return {
        "max_normal_error": float(np.abs(lengths - 1).max(initial=0.0)),
        "min_normal_dot": float(dots.min(initial=1.0)),
    }


def report(path):
    mesh, normals, parts = load(path)
    if len(mesh.faces) == 0:
        return {"file": path, "vertices": len(mesh.vertices), "faces": 0, "empty": True}
    welded = path.endswith(".stl")
    face_normals = None
    if welded:
        face_normals = stl_normals(path)
        mesh = weld(mesh)
    edges = np.sort(mesh.edges, axis=1).astype(np.uint64)
    _, uses = np.unique(edges[:, 0] << np.uint64(32) | edges[:, 1], return_counts=True)
    faces = np.sort(mesh.faces, axis=1)
    used = np.unique(mesh.faces)
    out = {
        "file": path,
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "empty": False,
        "welded": welded,
        "watertight": bool(mesh.is_watertight),
        "winding_consistent": bool(mesh.is_winding_consistent),
        "is_volume": bool(mesh.is_volume),
        "euler": int(len(used) - len(uses) + len(mesh.faces)),
        "area": float(mesh.area),
        "volume": float(mesh.volume),
        "bodies": int(mesh.body_count),
        "bounds": mesh.bounds.tolist(),
        "nan_count": int(np.count_nonzero(~np.isfinite(mesh.vertices)))
        + (0 if normals is None else int(np.count_nonzero(~np.isfinite(normals)))),
        "unused_vertices": int(len(mesh.vertices) - len(used)),
        "duplicate_faces": int(len(faces) - len(np.unique(faces, axis=0))),
        "degenerate_faces": int(np.count_nonzero((faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]))),
        "bad_edges": int(np.count_nonzero(uses != 2)),
        "max_normal_error": None,
        "min_normal_dot": None,
        "min_face_normal_dot": None,
        "attributes": sorted(k for p in parts for k in p.vertex_attributes) if parts else [],
    }
    if normals is not None:
        out.update(normal_report(mesh, normals))
    if face_normals is not None:
        corners = mesh.vertices[mesh.faces]
        crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(crosses, axis=1)
        large = size > 1e-4  # smaller ones are mostly rounding of the coordinates
        dots = np.einsum("ij,ij->i", face_normals[large], crosses[large]) / size[large]
        out["min_face_normal_dot"] = float(dots.min(initial=1.0))
    return out


def finite(value):
    """Replaces NaN and infinity, which JSON lacks, by null."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def main():
    np.seterr(all="ignore")  # broken meshes give NaN
    paths = sys.argv[1:]
    for path in paths or (line.rstrip("\n") for line in sys.stdin):
        if not path:
            continue
        try:
            answer = report(path)
        except Exception as error:  # readers of broken files raise errors of any type
            answer = {"file": path, "error": f"{type(error).__name__}: {error}"}
        print(json.dumps(finite(answer), allow_nan=False), flush=True)


if __name__ == "__main__":
    main()
