"""Tables of a point map on disk: feather, the same bytes for the same values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final
from zlib import crc32

import numpy as np

from hdmap_tools.errors import HDMapError, PointMapError
from hdmap_tools.geometry.se3 import Trajectory
from hdmap_tools.readers.arrow import values_of
from hdmap_tools.types import NDArrayAny

_TYPES: Final = {
    **dict.fromkeys(("x_mm", "y_mm", "z_mm", "hits"), np.int32),
    **dict.fromkeys(("height_mm", "roughness_mm", "points"), np.int32),
    "intensity": np.uint8,
    "is_ground": np.bool_,
    "cell": np.uint16,
    "timestamp_ns": np.int64,
    **dict.fromkeys(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), np.float64),
}
_POSE_COLUMNS: Final = ("timestamp_ns", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")


def write_table(path: Path, columns: Mapping[str, NDArrayAny]) -> int:
    """Write columns of one length; gives the CRC-32 of the file."""
    import pyarrow as pa
    import pyarrow.feather

    arrays = {name: pa.array(np.ascontiguousarray(a, _TYPES[name])) for name, a in columns.items()}
    stream = pa.BufferOutputStream()
    pyarrow.feather.write_feather(pa.table(arrays), stream, compression="lz4")
    written = stream.getvalue()
    path.write_bytes(written)
    return crc32(written)


def read_table(
    path: Path, names: Sequence[str], expected_crc: int | None = None
) -> dict[str, NDArrayAny]:
    """Columns by name, of the types that `write_table` wrote.

    Raises:
        PointMapError: If the file is missing, truncated, lacks a column, or is not the one
            that was written with that CRC-32.
    """
    import pyarrow as pa
    import pyarrow.feather

    try:
        content = path.read_bytes()
        table = pyarrow.feather.read_table(pa.BufferReader(content))
        table.validate(full=True)
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise PointMapError(
            f"{path} of the point map cannot be read ({reason:.120}); it is missing or truncated. Copy "
            "the map again, or make it anew with `hdmap points`."
        ) from error
    if expected_crc is not None and crc32(content) != expected_crc:
        raise PointMapError(
            f"{path} of the point map is not the file that was written with the map; it is damaged, or of "
            "another tile or map. Copy the map again, or make it anew with `hdmap points`."
        )
    columns = {}
    for name in names:
        found = values_of(table[name]) if name in table.column_names else np.zeros(0)
        if name not in table.column_names or found.dtype != _TYPES[name]:
            raise PointMapError(
                f"{path} of the point map has no column {name} of type {np.dtype(_TYPES[name])}; make the "
                "map anew with `hdmap points`."
            )
        columns[name] = found
    return columns


def write_poses(path: Path, trajectory: Trajectory) -> None:
    """Write ``city_SE3_ego`` over time, in the columns of an Argoverse 2 pose table."""
    quaternions = np.array([trajectory.pose(k).quaternion_wxyz for k in range(len(trajectory))])
    values = (trajectory.timestamps_ns, *quaternions.T, *trajectory.translations.T)
    write_table(path, dict(zip(_POSE_COLUMNS, values, strict=True)))


def read_poses(path: Path) -> Trajectory:
    """What `write_poses` wrote.

    Raises:
        PointMapError: If the file is missing or holds no poses.
    """
    columns = read_table(path, _POSE_COLUMNS)
    values = [columns[name] for name in _POSE_COLUMNS]
    try:
        return Trajectory.from_quaternions(
            values[0], np.column_stack(values[1:5]), np.column_stack(values[5:8])
        )
    except HDMapError as error:
        raise PointMapError(f"{path} of the point map: {error}") from error
