from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, TypedDict, final, overload

from numpy import float32, float64, str_, uint8, uint32, void
from numpy.typing import ArrayLike, NDArray
from trimesh import Trimesh
from typing_extensions import Required, Unpack

__all__ = ["PARAMETERS", "Error", "Mesh", "Structure", "__version__", "areas", "read", "render", "surface"]

_File = str | PathLike[str] | bytes | bytearray | memoryview
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
