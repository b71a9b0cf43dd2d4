"""Writer of binary PLY, for peers that are Python libraries."""

import numpy as np


def write(path, vertices, faces, normals=None):
    """Writes `vertices` and `normals` (N × 3, Å) and `faces` (M × 3, indices of vertices) as 32-bit values."""
    columns = [vertices] if normals is None else [vertices, normals]
    names = ["x", "y", "z", "nx", "ny", "nz"][: 3 * len(columns)]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    head += [f"property float {name}" for name in names]
    head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"] = 3
    rows["corners"] = faces
    with open(path, "wb") as file:
        file.write("\n".join(head).encode())
        np.hstack([np.asarray(column, dtype="<f4") for column in columns]).tofile(file)
        rows.tofile(file)
