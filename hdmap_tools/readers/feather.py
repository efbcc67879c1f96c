"""Read columns of a feather (Arrow) table, with errors that say what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hdmap_tools.errors import DriveError
from hdmap_tools.types import NDArrayAny


def read_columns(
    path: Path,
    required: Sequence[str],
    optional: Sequence[str],
    error_type: type[DriveError],
) -> dict[str, NDArrayAny]:
    """Columns by name, each (N,), in the order required, then optional ones that exist.

    Missing values become NaN in numeric columns.

    Args:
        path: The file.
        required: Columns that must exist; numeric, except ``sensor_name``.
        optional: Columns read if they exist.
        error_type: What to raise.

    Raises:
        DriveError: As error_type, if the file is missing, broken, lacks a required
            column, or a column is not numeric.
    """
    import pyarrow as pa
    import pyarrow.feather

    if not path.is_file():
        raise error_type(f"{path} is missing; expected a feather table with {', '.join(required)}.")
    try:
        # No memory map: a file cut short while it is mapped would kill the process.
        table = pyarrow.feather.read_table(path, memory_map=False)
    except (pa.ArrowException, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise error_type(
            f"{path} is not a readable feather table ({path.stat().st_size} bytes: {reason}); it is "
            "truncated or of another format. Copy it again."
        ) from error
    missing = [name for name in required if name not in table.column_names]
    if missing:
        raise error_type(
            f"{path} lacks the columns {', '.join(missing)}; it has "
            f"{', '.join(table.column_names) or 'none'}."
        )
    columns: dict[str, NDArrayAny] = {}
    for name in (*required, *(name for name in optional if name in table.column_names)):
        values = np.asarray(table[name].to_numpy())
        if name != "sensor_name" and not np.issubdtype(values.dtype, np.number):
            raise error_type(f"{path}: column {name} is {values.dtype}; expected numbers.")
        columns[name] = values
    return columns
