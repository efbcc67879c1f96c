"""Point clouds of others: PCD and PLY through open3d, LAS and LAZ through laspy."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from hdmap_tools.errors import CRSMismatchError, MissingExtraError, OutputExistsError, PointMapError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.point_map.values import MapPoints
from hdmap_tools.types import NDArrayAny, NDArrayBool, NDArrayByte, NDArrayFloat

OPEN3D_SUFFIXES: Final = (".pcd", ".ply")
LAS_SUFFIXES: Final = (".las", ".laz")
SUFFIXES: Final = OPEN3D_SUFFIXES + LAS_SUFFIXES

_LAS_GROUND: Final = 2
_LAS_NOT_GROUND: Final = 1
_LAS_SCALE_M: Final = 0.001
_FEWEST: Final = 10
_FURTHEST_M: Final = np.array([2e7, 2e7, 1e5])
"""Along x, y and z: northings end at 1e7, and whole millimetres of height fit 32 bits."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """A point cloud as its file has it.

    Attributes:
        points: (N, 3) float64, finite; metres of `crs`, or of a frame that the file does not tell.
        intensity: (N,) uint8, None where the file has none.
        is_ground: (N,) where the file classifies any point so (LAS class 2), else None.
        crs: Of a georeferenced LAS file, a `pyproj.CRS`; None if it has none.
        num_dropped: Points with coordinates that are NaN, infinite or not of this earth.
    """

    points: NDArrayFloat
    intensity: NDArrayByte | None
    is_ground: NDArrayBool | None
    crs: Any = None
    num_dropped: int = 0

    def __len__(self) -> int:
        return len(self.points)

    def in_frame(self, frame: MapFrame) -> NDArrayFloat:
        """(N, 3) city points; without a CRS the numbers are taken as city metres.

        Raises:
            CRSMismatchError: If the file has a place on earth and the frame has none, or
                the points have no place in the frame.
        """
        if self.crs is None:
            return self.points
        if not frame.is_georeferenced:
            raise CRSMismatchError(
                f"The point cloud lies in {self.crs.name!r} and the city frame has no place on earth; give "
                "one with --origin LAT,LON[,ALT]."
            )
        from pyproj import Transformer

        transformer = Transformer.from_crs(self.crs, frame.crs, always_xy=True)
        x, y = transformer.transform(self.points[:, 0], self.points[:, 1])
        city = np.column_stack([x, y, self.points[:, 2]]) - frame.offset_m
        if not np.isfinite(city).all():
            raise CRSMismatchError(
                f"The point cloud in {self.crs.name!r} has points without a place in {frame.describe()}."
            )
        return np.asarray(city)


def is_point_file(path: Path) -> bool:
    """Whether a path names a point cloud by its suffix."""
    return path.suffix.lower() in SUFFIXES


def read_point_file(path: Path) -> PointCloud:
    """Read a point cloud.

    Raises:
        PointMapError: If it is missing, unreadable, or has no usable points.
        MissingExtraError: For LAS without laspy.
    """
    if not path.is_file():
        raise PointMapError(f"No point cloud {path}.")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise PointMapError(f"{path}: expected a point cloud {', '.join(SUFFIXES)}.")
    cloud = _read_las(path) if suffix in LAS_SUFFIXES else _read_open3d(path)
    # NaN compares false.
    finite: NDArrayBool = np.asarray((np.abs(cloud.points) <= _FURTHEST_M).all(axis=1))
    if finite.sum() < _FEWEST:
        raise PointMapError(
            f"{path} has {len(finite)} points, {int(finite.sum())} of them usable; expected a point cloud of "
            "a street, finite, in metres."
        )
    return PointCloud(
        cloud.points[finite],
        None if cloud.intensity is None else cloud.intensity[finite],
        None if cloud.is_ground is None else cloud.is_ground[finite],
        cloud.crs,
        int((~finite).sum()),
    )


def check_writable(path: Path, overwrite: bool) -> None:
    """Say before the work what would keep `write_point_file` from writing.

    Raises:
        PointMapError: If the suffix is of no known format.
        MissingExtraError: For LAS without laspy.
        OutputExistsError: If the file exists and is not to be replaced.
    """
    if not is_point_file(path):
        raise PointMapError(f"{path}: points are written as {', '.join(SUFFIXES)}.")
    if path.suffix.lower() in LAS_SUFFIXES:
        _laspy()
    if path.exists() and not overwrite:
        raise OutputExistsError(f"{path} exists; use --overwrite to replace it.")


def write_point_file(
    path: Path, parts: Iterable[MapPoints], frame: MapFrame, overwrite: bool = False
) -> int:
    """Write points; gives how many. LAS keeps ground as class 2, and the frame's place on earth.

    PCD and PLY have city metres (double precision), intensity and is_ground; LAS has the
    coordinates of the frame's CRS to the millimetre, or city metres where it has none.

    Raises:
        PointMapError: If the suffix is of no known format.
        MissingExtraError: For LAS without laspy.
        OutputExistsError, FormatError: As `atomic_output`.
    """
    points = MapPoints.joined(list(parts))
    suffix = path.suffix.lower()
    check_writable(path, overwrite)
    if suffix in LAS_SUFFIXES:
        las = _to_las(points, frame)
        with atomic_output(path, overwrite) as temporary:
            las.write(str(temporary))
    else:
        cloud = _to_open3d(points)
        with atomic_output(path, overwrite) as temporary:
            from hdmap_tools.open3d_import import open3d

            if not open3d().t.io.write_point_cloud(str(temporary), cloud):
                raise PointMapError(f"open3d could not write {path}.")
            # It takes a disk that fills up for success.
            if (found := temporary.stat().st_size) < len(points) * _BYTES_A_POINT:
                raise PointMapError(
                    f"Cannot write {path}: {len(points)} points need {len(points) * _BYTES_A_POINT} bytes, "
                    f"{found} were written; check free space."
                )
    return len(points)


_BYTES_A_POINT: Final = 3 * 8 + 1 + 1
"""Of PCD and PLY: position, intensity, is_ground."""


def _laspy() -> Any:
    try:
        import laspy
    except ImportError as error:
        raise MissingExtraError(
            "LAS and LAZ need laspy: pip install 'hdmap-tools[lidar]'."
        ) from error
    return laspy


def _read_las(path: Path) -> PointCloud:
    laspy = _laspy()
    try:
        las = laspy.read(path)
        crs = las.header.parse_crs()
        points = np.column_stack([np.asarray(las.x), np.asarray(las.y), np.asarray(las.z)])
        intensity = np.asarray(las.intensity, dtype=np.float64)
        is_ground = np.asarray(las.classification) == _LAS_GROUND
    except Exception as error:  # laspy's back ends raise their own, and struct and value errors
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise PointMapError(
            f"{path} is not a readable LAS file ({reason:.120}); copy it again."
        ) from error
    return PointCloud(points, _to_byte(intensity), is_ground if is_ground.any() else None, crs)


def _read_open3d(path: Path) -> PointCloud:
    from hdmap_tools.open3d_import import open3d

    if path.suffix.lower() == ".ply":
        _require_whole_ply(path)
    o3d = open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            cloud = o3d.t.io.read_point_cloud(
                str(path), remove_nan_points=False, remove_infinite_points=False
            )
        except RuntimeError as error:
            raise PointMapError(f"{path} is not a readable point cloud: {error!s:.120}") from error
    if "positions" not in cloud.point or len(cloud.point.positions) == 0:
        raise PointMapError(f"{path} is empty or not a readable point cloud; copy it again.")
    points = cloud.point.positions.numpy().astype(np.float64)
    intensity = _column(cloud, "intensity")
    ground = _column(cloud, "is_ground")
    return PointCloud(
        points,
        None if intensity is None else _to_byte(intensity),
        None if ground is None or not ground.any() else ground > 0.5,
    )


_PLY_BYTES: Final = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64", "int64", "uint64"), 8),
}


def _require_whole_ply(path: Path) -> None:
    """Raise `PointMapError` if a PLY is cut short: open3d 0.20 fills the rest with whatever memory held."""
    with path.open("rb") as file:
        lines = []
        for _ in range(1000):
            line = file.readline(1000).decode("ascii", errors="replace").split()
            lines.append(line)
            if line[:1] == ["end_header"] or (not line and file.read(1) == b""):
                break
        begin = file.tell()
        is_ascii = ["format", "ascii", "1.0"] in lines
        count, row, in_vertices = 0, 0, False
        for line in lines:
            if line[:1] == ["element"] and len(line) == 3:
                in_vertices = line[1] == "vertex"
                count = int(line[2]) if in_vertices and line[2].isdigit() else count
            elif in_vertices and line[:1] == ["property"] and len(line) == 3:
                row += 2 if is_ascii else _PLY_BYTES.get(line[1], 0)
    found = path.stat().st_size - begin
    if lines[:1] != [["ply"]] or count == 0 or found < count * row:
        raise PointMapError(
            f"{path} is no whole PLY file: {count} points need at least {count * row} bytes after the header, "
            f"found {found}; copy it again."
        )


def _column(cloud: Any, name: str) -> NDArrayFloat | None:
    if name not in cloud.point:
        return None
    return np.asarray(cloud.point[name].numpy().reshape(-1), dtype=np.float64)


def _to_byte(intensity: NDArrayFloat) -> NDArrayByte | None:
    """Intensity 0..255 of values 0..1, 0..255 or 0..65535, whichever they are; None if all are equal."""
    values = np.where(np.isfinite(intensity), intensity, 0.0)
    high = float(values.max(initial=0.0))
    if high <= 0.0:
        return None
    scale = 255.0 if high <= 1.0 else 1.0 if high <= 255.0 else 255.0 / 65535.0
    return np.clip(np.rint(values * scale), 0, 255).astype(np.uint8)


def _to_las(points: MapPoints, frame: MapFrame) -> Any:
    laspy = _laspy()
    header = laspy.LasHeader(point_format=6, version="1.4")
    if frame.is_georeferenced:
        header.add_crs(frame.crs)
    at = points.points_city + (frame.offset_m if frame.is_georeferenced else (0.0, 0.0, 0.0))
    header.scales = np.full(3, _LAS_SCALE_M)
    header.offsets = np.floor(at.min(axis=0) / 1000.0) * 1000.0 if len(at) else np.zeros(3)
    # The same map gives the same bytes: no date of today.
    header.creation_date = None
    header.generating_software = "hdmap_tools"
    las = laspy.LasData(header)
    las.x, las.y, las.z = at.T
    las.intensity = points.intensity.astype(np.uint16)
    las.classification = np.where(points.is_ground, _LAS_GROUND, _LAS_NOT_GROUND).astype(np.uint8)
    return las


def _to_open3d(points: MapPoints) -> Any:
    from hdmap_tools.open3d_import import open3d

    o3d = open3d()

    def tensor(values: NDArrayAny) -> Any:
        return o3d.core.Tensor(np.ascontiguousarray(values))

    cloud = o3d.t.geometry.PointCloud()
    cloud.point["positions"] = tensor(points.points_city)
    cloud.point["intensity"] = tensor(points.intensity[:, None])
    cloud.point["is_ground"] = tensor(points.is_ground.astype(np.uint8)[:, None])
    return cloud
