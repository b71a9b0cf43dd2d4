from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, TypedDict, final, overload

from numpy import float32, float64, str_, uint8, uint32, void
from numpy.typing import ArrayLike, NDArray
from trimesh import Trimesh
from typing_extensions import Required, Self, Unpack

__all__ = [
    "PARAMETERS",
    "AsyncBatch",
    "AsyncClient",
    "AsyncJob",
    "Batch",
    "Cavity",
    "Client",
    "Error",
    "Job",
    "MapResult",
    "Mesh",
    "Pocket",
    "Structure",
    "__version__",
    "areas",
    "cavities",
    "pockets",
    "read",
    "render",
    "surface",
]

_Path = str | PathLike[str]
_File = _Path | bytes | bytearray | memoryview
_Progress = Callable[[str, float], object] | None

__version__: str
PARAMETERS: dict[str, str]

class Error(Exception):
    type: str
    limit: int | None
    value: int | str | None
    suggested_resolution: float | None
    line: int | None
    column: int | None

class _Selection(TypedDict, total=False):
    select: str | None
    chains: str | Sequence[str] | None
    model: int | str | None
    altloc: str | None
    assembly: str | int | None

class _Checked(_Selection, total=False):
    check: str | None

class _Areas(_Selection, total=False):
    by: str | None
    surface: Required[str]
    probe: float | None
    radius_scale: float | None
    radius_offset: float | None
    interface: str | Sequence[str] | None

class _Cavities(_Selection, total=False):
    probe: float | None
    radius_scale: float | None
    radius_offset: float | None

class _Pockets(_Cavities, total=False):
    pocket_probe: float | None

class _Surface(_Checked, total=False):
    preset: str | None
    surface: str | None
    probe: float | None
    resolution: float | None
    detail: int | None
    max_triangles: int | None
    isovalue: float | None
    smoothness: float | None
    radius_scale: float | None
    radius_offset: float | None
    cutoff_tolerance: float | None
    paper_a: float | None
    paper_b: float | None
    paper_c: float | None
    atom_ids: bool | None
    exact: bool | None
    interface: str | Sequence[str] | None
    color: str | None
    palette: str | None
    color_range: str | Sequence[float] | None
    color_blend: str | None
    color_offset: float | None
    instances: bool | None
    unit: int | None
    context: str | None
    split: str | None
    cavities: str | None
    pockets: bool | None
    pocket_probe: float | None
    simplify: float | None
    tile: str | None
    quality: str | None
    validation: str | None
    compress: str | None
    normals: str | None
    units: str | None

class _Picture(TypedDict, total=False):
    width: int | None
    height: int | None
    view: str | None
    azimuth: float | None
    elevation: float | None
    background: str | None
    style: str | None

class _Render(_Surface, _Picture, total=False): ...

class _Batch(_Render, total=False):
    by: str | None

@final
class Structure:
    def __len__(self) -> int: ...
    @property
    def coordinates(self) -> NDArray[float64]: ...
    @property
    def radii(self) -> NDArray[float32]: ...
    @property
    def elements(self) -> NDArray[str_]: ...
    @property
    def names(self) -> NDArray[str_]: ...
    @property
    def residues(self) -> NDArray[void]: ...
    @property
    def chains(self) -> NDArray[str_]: ...
    @property
    def b_factors(self) -> NDArray[float32] | None: ...
    @property
    def charges(self) -> NDArray[float32] | None: ...
    @property
    def indices(self) -> NDArray[uint32]: ...
    @property
    def left_out(self) -> dict[str, Any]: ...
    @property
    def warnings(self) -> list[str]: ...
    @property
    def id(self) -> str | None: ...
    @property
    def title(self) -> str | None: ...
    @property
    def format(self) -> str: ...

@final
class Mesh:
    @property
    def vertices(self) -> NDArray[float32]: ...
    @property
    def faces(self) -> NDArray[uint32]: ...
    @property
    def normals(self) -> NDArray[float32]: ...
    @property
    def atom(self) -> NDArray[uint32] | None: ...
    @property
    def colors(self) -> NDArray[uint8] | None: ...
    @property
    def area(self) -> float: ...
    @property
    def volume(self) -> float | None: ...
    @property
    def components(self) -> int: ...
    @property
    def closed(self) -> bool: ...
    @property
    def report(self) -> dict[str, Any]: ...
    def save(self, path: str | PathLike[str], *, format: str | None = None) -> None: ...
    def to_trimesh(self) -> Trimesh: ...
    def _repr_png_(self) -> bytes | None: ...

@final
class Cavity:
    @property
    def center(self) -> tuple[float, float, float]: ...
    @property
    def radius(self) -> float: ...
    @property
    def volume(self) -> float: ...
    @property
    def area(self) -> float: ...
    @property
    def accessible_volume(self) -> float: ...
    @property
    def accessible_area(self) -> float: ...
    @property
    def opening_radius(self) -> float: ...
    @property
    def atoms(self) -> NDArray[uint32]: ...

@final
class Pocket:
    @property
    def center(self) -> tuple[float, float, float]: ...
    @property
    def volume(self) -> float: ...
    @property
    def area(self) -> float: ...
    @property
    def depth(self) -> float: ...
    @property
    def openings(self) -> int: ...
    @property
    def atoms(self) -> NDArray[uint32]: ...

def read(source: _File, *, progress: _Progress = None, **parameters: Unpack[_Checked]) -> Structure: ...
@overload
def surface(
    source: _File | Structure,
    radii: None = None,
    *,
    map: _File | None = None,
    progress: _Progress = None,
    **parameters: Unpack[_Surface],
) -> Mesh: ...
@overload
def surface(
    source: ArrayLike,
    radii: ArrayLike,
    *,
    map: _File | None = None,
    progress: _Progress = None,
    **parameters: Unpack[_Surface],
) -> Mesh: ...
@overload
def areas(
    source: _File | Structure, radii: None = None, *, progress: _Progress = None, **parameters: Unpack[_Areas]
) -> dict[str, NDArray[Any]]: ...
@overload
def areas(
    source: ArrayLike, radii: ArrayLike, *, progress: _Progress = None, **parameters: Unpack[_Areas]
) -> dict[str, NDArray[Any]]: ...
@overload
def cavities(
    source: _File | Structure, radii: None = None, *, progress: _Progress = None, **parameters: Unpack[_Cavities]
) -> list[Cavity]: ...
@overload
def cavities(
    source: ArrayLike, radii: ArrayLike, *, progress: _Progress = None, **parameters: Unpack[_Cavities]
) -> list[Cavity]: ...
@overload
def pockets(
    source: _File | Structure, radii: None = None, *, progress: _Progress = None, **parameters: Unpack[_Pockets]
) -> list[Pocket]: ...
@overload
def pockets(
    source: ArrayLike, radii: ArrayLike, *, progress: _Progress = None, **parameters: Unpack[_Pockets]
) -> list[Pocket]: ...
@overload
def render(
    source: Mesh,
    radii: None = None,
    *,
    map: None = None,
    progress: _Progress = None,
    **parameters: Unpack[_Picture],
) -> bytes: ...
@overload
def render(
    source: _File | Structure,
    radii: None = None,
    *,
    map: _File | None = None,
    progress: _Progress = None,
    **parameters: Unpack[_Render],
) -> bytes: ...
@overload
def render(
    source: ArrayLike,
    radii: ArrayLike,
    *,
    map: _File | None = None,
    progress: _Progress = None,
    **parameters: Unpack[_Render],
) -> bytes: ...

class MapResult(NamedTuple):
    source: _File
    content: bytes | Path | None = None
    error: Exception | None = None

class Job:
    @property
    def id(self) -> str: ...
    def status(self) -> dict[str, Any]: ...
    def wait(self, timeout: float | None = None) -> dict[str, Any]: ...
    @overload
    def result(self, timeout: float | None = None, *, save: None = None) -> bytes: ...
    @overload
    def result(self, timeout: float | None = None, *, save: _Path) -> Path: ...
    def cancel(self) -> dict[str, Any]: ...

class AsyncJob:
    @property
    def id(self) -> str: ...
    async def status(self) -> dict[str, Any]: ...
    async def wait(self, timeout: float | None = None) -> dict[str, Any]: ...
    @overload
    async def result(self, timeout: float | None = None, *, save: None = None) -> bytes: ...
    @overload
    async def result(self, timeout: float | None = None, *, save: _Path) -> Path: ...
    async def cancel(self) -> dict[str, Any]: ...

class Batch:
    @property
    def id(self) -> str: ...
    def status(self) -> dict[str, Any]: ...
    def files(self) -> Iterator[dict[str, Any]]: ...
    def wait(
        self, timeout: float | None = None, *, progress: Callable[[dict[str, Any]], object] | None = None
    ) -> dict[str, Any]: ...
    def results(self) -> Iterator[tuple[str, bytes]]: ...
    def save(self, folder: _Path) -> list[tuple[str, Path]]: ...
    def cancel(self) -> dict[str, Any]: ...

class AsyncBatch:
    @property
    def id(self) -> str: ...
    async def status(self) -> dict[str, Any]: ...
    def files(self) -> AsyncIterator[dict[str, Any]]: ...
    async def wait(
        self, timeout: float | None = None, *, progress: Callable[[dict[str, Any]], object] | None = None
    ) -> dict[str, Any]: ...
    def results(self) -> AsyncIterator[tuple[str, bytes]]: ...
    async def save(self, folder: _Path) -> list[tuple[str, Path]]: ...
    async def cancel(self) -> dict[str, Any]: ...

class Client:
    def __init__(self, url: str, key: str | None = None, *, timeout: float = 300.0) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...
    def close(self) -> None: ...
    def capabilities(self) -> dict[str, Any]: ...
    def upload(self, file: _File) -> str: ...
    @overload
    def mesh(
        self,
        source: _File,
        *,
        format: str | None = None,
        save: None = None,
        map: _File | None = None,
        **parameters: Unpack[_Render],
    ) -> bytes: ...
    @overload
    def mesh(
        self,
        source: _File,
        *,
        format: str | None = None,
        save: _Path,
        map: _File | None = None,
        **parameters: Unpack[_Render],
    ) -> Path: ...
    @overload
    def picture(
        self, source: _File, *, save: None = None, map: _File | None = None, **parameters: Unpack[_Render]
    ) -> bytes: ...
    @overload
    def picture(
        self, source: _File, *, save: _Path, map: _File | None = None, **parameters: Unpack[_Render]
    ) -> Path: ...
    def report(self, source: _File, *, map: _File | None = None, **parameters: Unpack[_Render]) -> dict[str, Any]: ...
    def estimate(self, source: _File, *, map: _File | None = None, **parameters: Unpack[_Render]) -> dict[str, Any]: ...
    def areas(self, source: _File, **parameters: Unpack[_Areas]) -> dict[str, NDArray[Any]]: ...
    def submit(
        self, source: _File, *, format: str = "glb", map: _File | None = None, **parameters: Unpack[_Render]
    ) -> Job: ...
    def job(self, id: str) -> Job: ...
    def jobs(self, state: str | None = None) -> Iterator[dict[str, Any]]: ...
    def submit_batch(
        self,
        files: Iterable[_File] | Mapping[str, _File],
        *,
        outputs: str | Sequence[str] = "glb",
        **parameters: Unpack[_Batch],
    ) -> Batch: ...
    def batch(self, id: str) -> Batch: ...
    def map(
        self,
        files: Iterable[_File],
        *,
        format: str = "glb",
        save: _Path | None = None,
        concurrency: int | None = None,
        progress: bool = False,
        **parameters: Unpack[_Render],
    ) -> Iterator[MapResult]: ...

class AsyncClient:
    def __init__(self, url: str, key: str | None = None, *, timeout: float = 300.0) -> None: ...
    async def __aenter__(self) -> Self: ...
    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None: ...
    async def aclose(self) -> None: ...
    async def capabilities(self) -> dict[str, Any]: ...
    async def upload(self, file: _File) -> str: ...
    @overload
    async def mesh(
        self,
        source: _File,
        *,
        format: str | None = None,
        save: None = None,
        map: _File | None = None,
        **parameters: Unpack[_Render],
    ) -> bytes: ...
    @overload
    async def mesh(
        self,
        source: _File,
        *,
        format: str | None = None,
        save: _Path,
        map: _File | None = None,
        **parameters: Unpack[_Render],
    ) -> Path: ...
    @overload
    async def picture(
        self, source: _File, *, save: None = None, map: _File | None = None, **parameters: Unpack[_Render]
    ) -> bytes: ...
    @overload
    async def picture(
        self, source: _File, *, save: _Path, map: _File | None = None, **parameters: Unpack[_Render]
    ) -> Path: ...
    async def report(
        self, source: _File, *, map: _File | None = None, **parameters: Unpack[_Render]
    ) -> dict[str, Any]: ...
    async def estimate(
        self, source: _File, *, map: _File | None = None, **parameters: Unpack[_Render]
    ) -> dict[str, Any]: ...
    async def areas(self, source: _File, **parameters: Unpack[_Areas]) -> dict[str, NDArray[Any]]: ...
    async def submit(
        self, source: _File, *, format: str = "glb", map: _File | None = None, **parameters: Unpack[_Render]
    ) -> AsyncJob: ...
    def job(self, id: str) -> AsyncJob: ...
    def jobs(self, state: str | None = None) -> AsyncIterator[dict[str, Any]]: ...
    async def submit_batch(
        self,
        files: Iterable[_File] | Mapping[str, _File],
        *,
        outputs: str | Sequence[str] = "glb",
        **parameters: Unpack[_Batch],
    ) -> AsyncBatch: ...
    def batch(self, id: str) -> AsyncBatch: ...
    def map(
        self,
        files: Iterable[_File],
        *,
        format: str = "glb",
        save: _Path | None = None,
        concurrency: int | None = None,
        progress: bool = False,
        **parameters: Unpack[_Render],
    ) -> AsyncIterator[MapResult]: ...
