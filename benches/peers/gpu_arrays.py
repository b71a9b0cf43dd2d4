"""Density and marching cubes as array operations, in PyTorch, and in NumPy as a check.

The field adds the grid points of all atoms into the grid by index (atomic additions on a device). The surface uses
masks of crossed edges, prefix sums for vertex numbers, and lookups of the case table. NumPy and PyTorch share the code.
"""

import math
import re
from pathlib import Path

import numpy as np

SMOOTHNESS, TOLERANCE = 1.25, 0.01
TAIL = math.log(1 / TOLERANCE)
END = 1 + TAIL / SMOOTHNESS
SCALE = 1 / (1 - TOLERANCE * (1 + TAIL))
CASES = Path(__file__).resolve().parents[2] / "crates/surface/src/cases.rs"


def case_table():
    """Returns our 256 cases: triangles per case (256) and their cell edges (256 × 16), uint8."""
    rows = re.search(r'ROWS: &str = "(.*?)";', CASES.read_text(), re.S).group(1).split()
    table = np.zeros((256, 16), np.uint8)
    for case, row in enumerate(rows):
        edges = [int(digit, 16) for digit in row.replace(".", "")]
        table[case, : len(edges)] = edges
    return np.array([len(row.replace(".", "")) // 3 for row in rows], np.uint8), table


class Numpy:
    """Array operations in NumPy."""

    name, device = "numpy", "host"
    int32, int64, float32, uint8 = np.int32, np.int64, np.float32, np.uint8

    def put(self, array):
        return np.ascontiguousarray(array)

    def get(self, array):
        return array

    def to(self, array, kind):
        return array.astype(kind)

    def zeros(self, shape, kind):
        return np.zeros(shape, kind)

    def arange(self, n):
        return np.arange(n)

    def where(self, flags):
        return np.flatnonzero(flags)

    def cumsum(self, array):
        return np.cumsum(array, dtype=np.int32)

    def repeat(self, array, counts):
        return np.repeat(array, counts)

    def scatter(self, grid, index, values):
        np.add.at(grid, index, values)

    def exp(self, array):
        return np.exp(array)

    def select(self, flags, values):
        return np.where(flags, values, np.float32(0))

    def stack(self, arrays):
        return np.stack(arrays, axis=1)


class Torch:
    """Array operations in PyTorch, on a device."""

    name = "torch"

    def __init__(self, device):
        import torch

        self.torch, self.device = torch, device
        self.int32, self.int64, self.float32, self.uint8 = torch.int32, torch.int64, torch.float32, torch.uint8

    def put(self, array):
        return self.torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

    def get(self, array):
        return array.cpu().numpy()

    def to(self, array, kind):
        return array.to(kind)

    def zeros(self, shape, kind):
        return self.torch.zeros(shape, dtype=kind, device=self.device)

    def arange(self, n):
        return self.torch.arange(n, device=self.device)

    def where(self, flags):
        return self.torch.nonzero(flags.reshape(-1)).reshape(-1)

    def cumsum(self, array):
        return self.torch.cumsum(array, 0, dtype=self.torch.int32)

    def repeat(self, array, counts):
        return self.torch.repeat_interleave(array, counts)

    def scatter(self, grid, index, values):
        grid.index_add_(0, index, values)

    def exp(self, array):
        return self.torch.exp(array)

    def select(self, flags, values):
        return self.torch.where(flags, values, self.torch.zeros((), device=self.device))

    def stack(self, arrays):
        return self.torch.stack(arrays, 1)


def pairs(xp, atoms, first, offsets, shape):
    """Returns grid point indices and densities of all pairs of an atom (n × 4: x, y, z, 1/r²) and an offset in its
    cube."""
    axes = []
    for k in range(3):
        at = first[:, k, None] + offsets
        d = xp.to(at, xp.float32) - atoms[:, k, None]
        axes.append((at, d * d * atoms[:, 3, None]))
    (ix, ux), (iy, uy), (iz, uz) = axes
    ex, ey, ez = (xp.exp(-SMOOTHNESS * u) for u in (ux, uy, uz))
    index = (ix[:, :, None, None] * shape[1] + iy[:, None, :, None]) * shape[2] + iz[:, None, None, :]
    u = ux[:, :, None, None] + uy[:, None, :, None] + uz[:, None, None, :]
    e = (ex * (math.exp(SMOOTHNESS) * SCALE))[:, :, None, None] * ey[:, None, :, None] * ez[:, None, None, :]
    value = e - (TOLERANCE * SCALE) * (1 + SMOOTHNESS * (END - u))
    return index.reshape(-1), xp.select(u < END, value).reshape(-1)


def scatter_field(xp, atoms, shape, widest, chunk=4096, step=pairs):
    """Returns the density at all grid points (flat, float32). `atoms` is on the device; `widest` is the largest
    support, in spacings."""
    grid = xp.zeros(math.prod(shape), xp.float32)
    offsets = xp.arange(math.floor(2 * widest) + 2)
    for begin in range(0, len(atoms), chunk):
        part = atoms[begin : begin + chunk]
        first = xp.to(part[:, :3] - widest, xp.int64) + 1
        index, values = step(xp, part, first, offsets, shape)
        xp.scatter(grid, index, values)
    return grid


def tables(xp):
    """Returns the case table and derived tables, on the device."""
    count, table = case_table()
    popcount = np.array([bin(m).count("1") for m in range(8)], np.int32)
    lower = np.array([[popcount[m & ((1 << axis) - 1)] for axis in range(3)] for m in range(8)], np.int32)
    return tuple(xp.put(array) for array in (count.astype(np.int64), table[:, :15].astype(np.int64), popcount, lower))


def surface(xp, field, shape, origin, spacing, lookup):
    """Returns the isosurface of a flat field at 1: vertices and normals (V × 3 each, Å) and triangles (T × 3)."""
    count, table, popcount, lower = lookup
    nx, ny, nz = shape
    steps = (ny * nz, nz, 1)
    inside = (field >= 1.0).reshape(shape)
    mask = xp.zeros(shape, xp.uint8)
    mask[:-1] |= xp.to(inside[1:] ^ inside[:-1], xp.uint8)
    mask[:, :-1] |= xp.to(inside[:, 1:] ^ inside[:, :-1], xp.uint8) * 2
    mask[:, :, :-1] |= xp.to(inside[:, :, 1:] ^ inside[:, :, :-1], xp.uint8) * 4
    mask = mask.reshape(-1)
    owners = xp.where(mask != 0)
    owned = mask[owners]
    numbers = popcount[xp.to(owned, xp.int64)]
    firsts = xp.cumsum(numbers) - numbers
    base = xp.zeros(field.shape[0], xp.int32)
    base[owners] = firsts
    total = int(firsts[-1] + numbers[-1]) if len(owners) else 0
    points, normals = xp.zeros((total, 3), xp.float32), xp.zeros((total, 3), xp.float32)

    def gradient(at):
        return xp.stack([field[at + s] - field[at - s] for s in steps])

    for axis in range(3):
        chosen = xp.where((owned >> axis) & 1)
        at = owners[chosen]
        ids = xp.to(firsts[chosen] + lower[xp.to(owned[chosen], xp.int64), axis], xp.int64)
        here, there = field[at], field[at + steps[axis]]
        t = (1.0 - here) / (there - here)
        place = [xp.to(c, xp.float32) for c in (at // steps[0], at // nz % ny, at % nz)]
        place[axis] = place[axis] + t
        points[ids] = xp.stack([place[k] * spacing + float(origin[k]) for k in range(3)])
        g = gradient(at)
        g = g + t[:, None] * (gradient(at + steps[axis]) - g)
        normals[ids] = -g / (g * g).sum(1)[:, None] ** 0.5
    cases = xp.zeros((nx - 1, ny - 1, nz - 1), xp.uint8)
    for c in range(8):
        x, y, z = c & 1, c >> 1 & 1, c >> 2 & 1
        cases |= xp.to(inside[x : nx - 1 + x, y : ny - 1 + y, z : nz - 1 + z], xp.uint8) << c
    cases = cases.reshape(-1)
    cells = xp.where((cases != 0) & (cases != 255))
    case = xp.to(cases[cells], xp.int64)
    number = count[case]
    ends = xp.to(xp.cumsum(number), xp.int64)
    of = xp.repeat(xp.arange(len(cells)), number)
    edges = table.reshape(-1, 5, 3)[case[of], xp.arange(len(of)) - (ends - number)[of]]
    point = (cells // ((ny - 1) * (nz - 1)) * ny + cells // (nz - 1) % (ny - 1)) * nz + cells % (nz - 1)
    axis, low, high = edges // 4, edges % 2, edges // 2 % 2
    offsets = xp.put(np.array([[nz, 1], [ny * nz, 1], [ny * nz, nz]]))
    owner = point[of][:, None] + low * offsets[axis, 0] + high * offsets[axis, 1]
    return points, normals, base[owner] + lower[xp.to(mask[owner], xp.int64), axis]
