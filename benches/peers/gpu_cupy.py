"""Runs the kernels of `gpu_kernels.cu` with CuPy: atoms to a dense field, field to an indexed mesh."""

import math
from pathlib import Path

import cupy
import numpy as np

from gpu_arrays import case_table

SOURCE = Path(__file__).with_name("gpu_kernels.cu")


class Kernels:
    def __init__(self):
        module = cupy.RawModule(code=SOURCE.read_text(), options=("--std=c++17", "-use_fast_math"))
        names = ("field", "count", "vertices", "triangles")
        self.field_kernel, self.count, self.vertices, self.triangles = map(module.get_function, names)
        count, table = case_table()
        self.number, self.table = cupy.asarray(count), cupy.asarray(table)

    def field(self, atoms, shape, widest):
        """Returns the density at all grid points (flat, float32). `atoms` is n × 4 float32 on the device: x, y, z,
        1/r²."""
        bricks = tuple(side // 8 for side in shape)
        bins = (atoms[:, :3] * np.float32(1 / 8)).astype(np.int32)
        keys = (bins[:, 0] * bricks[1] + bins[:, 1]) * bricks[2] + bins[:, 2]
        order = cupy.argsort(keys)
        ordered = atoms[order]
        total = math.prod(bricks)
        starts = cupy.searchsorted(keys[order], cupy.arange(total + 1, dtype=np.int32)).astype(np.int32)
        out = cupy.empty(math.prod(shape), np.float32)
        reach = np.int32(math.ceil(widest / 8))
        self.field_kernel((total,), (64,), (ordered, starts, *map(np.int32, bricks), reach, out))
        return out

    def surface(self, field, shape, origin, spacing):
        """Returns vertices with normals (V × 6, float32) and triangles (T × 3, uint32)."""
        sides = tuple(map(np.int32, shape))
        blocks = field.size // 256
        found = [cupy.empty(blocks, np.int32) for _ in range(2)]
        self.count((blocks,), (256,), (field, *sides, self.number, *found))
        ends = [cupy.cumsum(numbers, dtype=np.int32) for numbers in found]
        bases = [end - numbers for end, numbers in zip(ends, found)]
        active = cupy.flatnonzero(found[0] | found[1]).astype(np.int32)
        n_vertices, n_triangles = map(int, cupy.stack([end[-1] for end in ends]).get())
        points = cupy.empty((n_vertices, 6), np.float32)
        faces = cupy.empty((n_triangles, 3), np.uint32)
        ids = cupy.empty(field.size, np.uint32)
        if active.size:
            place = (*map(np.float32, origin), np.float32(spacing))
            self.vertices((active.size,), (256,), (field, *sides, active, bases[0], *place, ids, points))
            self.triangles(
                (active.size,), (256,), (field, *sides, active, bases[1], self.number, self.table, ids, faces)
            )
        return points, faces
