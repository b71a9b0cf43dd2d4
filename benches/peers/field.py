"""Computes our density on a dense grid with numba, as input of VTK and scikit-image.

Kernel, cut-off, lattice and radii are ours, so the surface is the same. The exponential of an atom is the product of
three short tables. Each thread computes a slab of x.
"""

import math

import gemmi
import numba
import numpy as np

from radii import RADII

SMOOTHNESS, TOLERANCE = 1.25, 0.01


def read(path):
    """Returns positions (N × 3, float64, Å) and radii (N, float32, Å) of the first model of a structure file."""
    structure = gemmi.read_structure(path)
    positions, radii = [], []
    for row in structure[0].all():
        positions.append(row.atom.pos.tolist())
        radii.append(RADII[row.atom.element.name.upper()])
    return np.array(positions), np.array(radii, dtype=np.float32)


def reach(radii):
    """Returns the radius of the support of an atom, Å."""
    return radii * math.sqrt(1 + math.log(1 / TOLERANCE) / SMOOTHNESS)


def dense(positions, radii, spacing):
    """Returns the density on a grid around the atoms (nx × ny × nz, float32) and the first grid point, Å."""
    ends = reach(radii)[:, None]
    low = np.floor((positions - ends).min(axis=0) / spacing) - 1
    high = np.ceil((positions + ends).max(axis=0) / spacing) + 1
    shape = (high - low).astype(np.int64) + 1
    order = np.argsort(positions[:, 0], kind="stable")
    local = (positions[order] / spacing - low).astype(np.float32)
    field = np.empty(shape, dtype=np.float32)
    splat(local, (radii[order] / spacing).astype(np.float32), field, numba.get_num_threads() * 8)
    return field, low * spacing


@numba.njit(parallel=True, fastmath=True, cache=True)
def splat(positions, radii, field, slabs):
    """Adds the densities of all atoms, sorted by x, in units of the spacing. Each thread computes a slab of x."""
    a, eps = np.float32(SMOOTHNESS), np.float32(TOLERANCE)
    tail = np.float32(math.log(1 / TOLERANCE))
    end = np.float32(1) + tail / a
    scale = np.float32(1) / (np.float32(1) - eps * (np.float32(1) + tail))
    nx, ny, nz = field.shape
    widest = radii.max() * math.sqrt(end)
    for slab in numba.prange(slabs):
        begin, stop = nx * slab // slabs, nx * (slab + 1) // slabs
        field[begin:stop] = 0
        first = np.searchsorted(positions[:, 0], np.float32(begin - widest - 1))
        last = np.searchsorted(positions[:, 0], np.float32(stop + widest + 1))
        span = int(2 * widest) + 4
        ez, uz = np.empty(span, np.float32), np.empty(span, np.float32)
        for atom in range(first, last):
            x, y, z = positions[atom]
            inverse = np.float32(1) / (radii[atom] * radii[atom])
            bound = radii[atom] * math.sqrt(end)
            z0, z1 = max(0, math.ceil(z - bound)), min(nz - 1, math.floor(z + bound))
            for k in range(z0, z1 + 1):
                uz[k - z0] = (k - z) * (k - z) * inverse
                ez[k - z0] = math.exp(-a * uz[k - z0])
            for i in range(max(begin, math.ceil(x - bound)), min(stop - 1, math.floor(x + bound)) + 1):
                ux = (i - x) * (i - x) * inverse
                ex = math.exp(a * (np.float32(1) - ux))
                for j in range(max(0, math.ceil(y - bound)), min(ny - 1, math.floor(y + bound)) + 1):
                    uxy = ux + (j - y) * (j - y) * inverse
                    if uxy >= end:
                        continue
                    exy = ex * math.exp(-a * (j - y) * (j - y) * inverse) * scale
                    half = math.sqrt((end - uxy) / inverse)
                    k0, k1 = max(z0, math.ceil(z - half)), min(z1, math.floor(z + half))
                    # Subtract ε(1 + a(end − u)), so that value and slope are 0 at the end.
                    base, slope = eps * (np.float32(1) + a * (end - uxy)) * scale, eps * a * scale
                    row = field[i, j]
                    for k in range(k0, k1 + 1):
                        row[k] += exy * ez[k - z0] - base + slope * uz[k - z0]
