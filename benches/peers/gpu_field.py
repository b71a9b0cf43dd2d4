"""Measures baselines for our GPU stages: a Gaussian field on a dense grid and marching cubes with PyTorch and CuPy.

    python3 gpu_field.py ATOMS.npz … --spacing 0.5 1.0 --runs 30 > baselines.json

atom_arrays.py writes ATOMS.npz. All baselines compute our density on our lattice from atoms on the device. Their
triangles are ours except for rounding. `molmesh-bench gpu` times the same work. The baselines:

* `torch`: array operations (gpu_arrays.py); pairs of an atom and a grid point are added by index;
* `torch.compile`: the same with that step compiled into one kernel;
* `cupy`: CUDA kernels (gpu_kernels.cu): sort atoms into bins, one block per brick of grid points, then count, prefix
  sum and two kernels that write shared vertices with normals, and triangles;
* `scikit-image (host)`: the field of the last baseline, contoured once on the host; only for small grids;
* `numpy (host)`, `torch (host)`: the array program without a device, on request, for tests.

Times are medians of device events in ms, after three unmeasured runs. A baseline that cannot run reports the reason.
"""

import argparse
import json
import math
import platform
import statistics
import sys
import time
from pathlib import Path

import numpy as np

import gpu_arrays

# Beyond this number of grid points, scikit-image would take minutes.
HOST_GRID_POINTS = 60_000_000


class Case:
    """Atoms on a lattice: `atoms` (N × 4, float32: x, y, z in spacings from the first grid point, 1/r²)."""

    def __init__(self, path, spacing):
        data = np.load(path)
        positions, radii = data["positions"], data["radii"]
        self.name, self.spacing = f"{Path(path).stem}-{spacing:g}", spacing
        self.widest = float(radii.max()) * math.sqrt(gpu_arrays.END) / spacing
        low = np.floor(positions.min(axis=0) / spacing - self.widest) - 2
        high = np.ceil(positions.max(axis=0) / spacing + self.widest) + 3
        self.shape = tuple(int(side + 8) // 8 * 8 for side in high - low)
        self.origin = low * spacing
        local = positions / spacing - low
        self.atoms = np.column_stack([local, (spacing / radii) ** 2]).astype(np.float32)
        self.n_grid_points = math.prod(self.shape)
        if self.n_grid_points >= 1 << 31:
            raise ValueError(f"{self.n_grid_points} grid points do not fit 31 bits")

    def reference(self, index):
        """Computes the density at grid points (flat indices) in double precision, atom by atom."""
        points = np.stack(np.unravel_index(index, self.shape), axis=1).astype(np.float64)
        out = np.empty(len(index))
        for i, point in enumerate(points):
            u = ((self.atoms[:, :3].astype(np.float64) - point) ** 2).sum(axis=1) * self.atoms[:, 3]
            u = u[u < gpu_arrays.END]
            tail = gpu_arrays.TOLERANCE * (1 + gpu_arrays.SMOOTHNESS * (gpu_arrays.END - u))
            out[i] = ((np.exp(gpu_arrays.SMOOTHNESS * (1 - u)) - tail) * gpu_arrays.SCALE).sum()
        return out


class HostClock:
    """Timer with the clock of the host."""

    def begin(self):
        self.start = time.perf_counter()

    def end(self):
        return (time.perf_counter() - self.start) * 1e3

    def peak(self):
        return None


class NumpyBaseline(HostClock):
    name = "numpy (host)"

    def __init__(self):
        self.xp = gpu_arrays.Numpy()
        self.lookup = gpu_arrays.tables(self.xp)

    def put(self, case):
        return self.xp.put(case.atoms)

    def field(self, case, atoms):
        return gpu_arrays.scatter_field(self.xp, atoms, case.shape, case.widest)

    def surface(self, case, field):
        return gpu_arrays.surface(self.xp, field, case.shape, case.origin, case.spacing, self.lookup)

    def host(self, array):
        return self.xp.get(array)


class TorchBaseline(NumpyBaseline):
    name = "torch"

    def __init__(self, device="cuda"):
        import torch

        if device == "cuda" and not torch.cuda.is_available():
            raise RuntimeError("PyTorch finds no device")
        self.torch = torch
        self.xp = gpu_arrays.Torch(device)
        self.lookup = gpu_arrays.tables(self.xp)

    def begin(self):
        self.first, self.last = (self.torch.cuda.Event(enable_timing=True) for _ in range(2))
        self.first.record()

    def end(self):
        self.last.record()
        self.last.synchronize()
        return self.first.elapsed_time(self.last)

    def clear(self):
        self.torch.cuda.empty_cache()
        self.torch.cuda.reset_peak_memory_stats()

    def peak(self):
        return self.torch.cuda.max_memory_allocated() / 1e6


class TorchHostBaseline(TorchBaseline):
    name = "torch (host)"
    begin, end, peak = HostClock.begin, HostClock.end, HostClock.peak

    def __init__(self):
        super().__init__("cpu")

    def clear(self):
        pass


class CompiledBaseline(TorchBaseline):
    name = "torch.compile"

    def __init__(self):
        super().__init__()

        def add(grid, part, first, offsets, ny, nz):
            index, values = gpu_arrays.pairs(self.xp, part, first, offsets, (0, ny, nz))
            grid.index_add_(0, index, values)

        self.add = self.torch.compile(add, dynamic=False)

    def field(self, case, atoms, chunk=16384):
        grid = self.xp.zeros(case.n_grid_points, self.xp.float32)
        offsets = self.xp.arange(math.floor(2 * case.widest) + 2)
        # All chunks have the same length, to compile once. Atoms too small to reach a grid point pad the last one.
        for begin in range(0, len(atoms), chunk):
            part = atoms[begin : begin + chunk]
            if len(part) < chunk:
                rest = atoms[:1].repeat(chunk - len(part), 1)
                rest[:, :3] = rest[:, :3].floor() + 0.5
                rest[:, 3] = 1e9
                part = self.torch.cat([part, rest])
            first = self.xp.to(part[:, :3] - case.widest, self.xp.int64) + 1
            self.add(grid, part, first, offsets, case.shape[1], case.shape[2])
        return grid


class CupyBaseline:
    name = "cupy"

    def __init__(self):
        import cupy

        import gpu_cupy

        self.cupy, self.kernels = cupy, gpu_cupy.Kernels()

    def put(self, case):
        return self.cupy.asarray(case.atoms)

    def field(self, case, atoms):
        return self.kernels.field(atoms, case.shape, case.widest)

    def surface(self, case, field):
        points, faces = self.kernels.surface(field, case.shape, case.origin, case.spacing)
        return points[:, :3], points[:, 3:], faces

    def host(self, array):
        return array.get()

    def begin(self):
        self.first, self.last = self.cupy.cuda.Event(), self.cupy.cuda.Event()
        self.first.record()

    def end(self):
        self.last.record()
        self.last.synchronize()
        return self.cupy.cuda.get_elapsed_time(self.first, self.last)

    def clear(self):
        self.cupy.get_default_memory_pool().free_all_blocks()

    def peak(self):
        # The pool frees nothing during a run, so its size is the peak.
        return self.cupy.get_default_memory_pool().total_bytes() / 1e6


def open_edges(faces, vertices):
    """Counts the edges that do not belong to exactly two triangles, on the host."""
    faces = faces.astype(np.int64)
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = np.sort(pairs.min(axis=1) * vertices + pairs.max(axis=1))
    uses = np.diff(np.flatnonzero(np.diff(keys, append=-1)), prepend=-1)
    return int((uses != 2).sum())


def area_and_volume(points, faces):
    """Returns area (Å²) and volume (Å³)."""
    a, b, c = (points[faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2), float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def timed(baseline, work, warm, runs):
    """Returns the median time of `runs` runs after `warm` unmeasured ones, ms, and the last result."""
    times, result = [], None
    for _ in range(warm + runs):
        result = None
        baseline.begin()
        result = work()
        times.append(baseline.end())
    return statistics.median(times[warm:]), result


def measure(baseline, case, warm, runs):
    """Returns times, counts and errors of one baseline on one case, and its field."""
    if hasattr(baseline, "clear"):
        baseline.clear()
    atoms = baseline.put(case)
    field_ms, field = timed(baseline, lambda: baseline.field(case, atoms), warm, runs)
    surface_ms, mesh = timed(baseline, lambda: baseline.surface(case, field), warm, runs)
    peak = baseline.peak()
    points, normals, faces = map(baseline.host, mesh)
    values = baseline.host(field)
    random = np.random.default_rng(1)
    index = np.concatenate([random.choice(np.flatnonzero(values), 300), random.integers(0, case.n_grid_points, 50)])
    error = float(np.abs(values[index] - case.reference(index)).max())
    area, volume = area_and_volume(points, faces)
    return {
        "field_ms": field_ms, "surface_ms": surface_ms, "sum_ms": field_ms + surface_ms, "peak_device_mb": peak,
        "triangles": len(faces), "vertices": len(points), "bad_edges": open_edges(faces, len(points)),
        "area": area, "volume": volume, "largest_field_error": error,
        "largest_normal_error": float(np.abs(np.linalg.norm(normals, axis=1) - 1).max(initial=0)),
    }, values  # fmt: skip


def on_host(case, values):
    """Times the marching cubes of scikit-image on a field, once."""
    if case.n_grid_points > HOST_GRID_POINTS:
        return {"skipped": f"{case.n_grid_points} grid points; above {HOST_GRID_POINTS} it would take minutes"}
    from skimage.measure import marching_cubes

    begin = time.perf_counter()
    points, faces, _, _ = marching_cubes(values.reshape(case.shape), 1.0, gradient_direction="ascent")
    return {"surface_ms": (time.perf_counter() - begin) * 1e3, "triangles": len(faces), "vertices": len(points)}


def device_name():
    try:
        import torch

        return torch.cuda.get_device_name() if torch.cuda.is_available() else platform.processor()
    except ImportError:
        return platform.processor()


BASELINES = {b.name: b for b in (TorchBaseline, CompiledBaseline, CupyBaseline, NumpyBaseline, TorchHostBaseline)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--spacing", type=float, nargs="+", default=[0.5, 1.0], help="Å")
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--warm", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=list(BASELINES), default=["torch", "torch.compile", "cupy"])
    given = parser.parse_args()
    result = {"device": device_name(), "python": platform.python_version(), "runs": given.runs, "cases": {}}
    for module in ("torch", "cupy", "skimage", "numpy"):
        try:
            result[module] = __import__(module).__version__
        except ImportError:
            result[module] = None
    baselines = {}
    for name in given.only:
        try:
            baselines[name] = BASELINES[name]()
        except Exception as error:  # report an unavailable baseline in its row
            baselines[name] = f"{type(error).__name__}: {error}"[:500]
    for file, spacing in ((file, spacing) for file in given.files for spacing in given.spacing):
        case, values = Case(file, spacing), None
        rows = {"atoms": len(case.atoms), "grid_points": case.n_grid_points, "grid": list(case.shape)}
        for name, baseline in baselines.items():
            try:
                if isinstance(baseline, str):
                    raise RuntimeError(baseline)
                rows[name], values = measure(baseline, case, given.warm, given.runs)
            except Exception as error:
                rows[name] = {"failed": f"{type(error).__name__}: {error}"[:500]}
            print(f"{case.name} {name}: {rows[name]}", file=sys.stderr, flush=True)
            if hasattr(baseline, "clear"):
                baseline.clear()
        if values is not None:
            try:
                rows["scikit-image (host)"] = on_host(case, values)
            except ImportError as error:
                rows["scikit-image (host)"] = {"failed": str(error)}
        result["cases"][case.name] = rows
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
