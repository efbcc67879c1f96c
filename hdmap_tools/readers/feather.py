"""Read columns of a feather (Arrow) table, with errors that say what is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hdmap_tools.errors import DriveError
from hdmap_tools.readers.arrow import values_of
from hdmap_tools.readers.checks import shown_names
from hdmap_tools.types import NDArrayAny


def read_columns(
    path: Path,
    required: Sequence[str],
    optional: Sequence[str],
    error_type: type[DriveError],
) -> dict[str, NDArrayAny]:
    """Columns by name, each (N,), in the order required, then optional ones that exist.

    Missing values become NaN in numeric columns, which makes whole numbers float64.

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
        # Offsets and lengths inside the file are not checked otherwise, and reading
        # by wrong ones is reading memory that is not the table's.
        table.validate(full=True)
    except PermissionError as error:
        raise error_type(f"{path} cannot be read: permission denied.") from error
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise error_type(
            f"{path} is not a readable feather table ({path.stat().st_size} bytes: {reason}); it is "
            "truncated or of another format. Copy it again."
        ) from error
    names = table.column_names
    missing = [name for name in required if name not in names]
    if missing:
        raise error_type(
            f"{path} lacks the columns {', '.join(missing)}; it has {shown_names(names)}."
        )
    columns: dict[str, NDArrayAny] = {}
    for name in (*required, *(name for name in optional if name in names)):
        if names.count(name) > 1:
            raise error_type(f"{path} has {names.count(name)} columns called {name}; expected one.")
        column = table[name]
        if pa.types.is_dictionary(column.type):
            column = column.cast(column.type.value_type)
        values = values_of(column)
        if name == "sensor_name":
            if not all(isinstance(value, str) for value in values):
                raise error_type(f"{path}: column {name} is {column.type}; expected names.")
        # The kinds of whole and floating numbers; durations count as numbers elsewhere.
        elif values.dtype.kind not in "iuf":
            raise error_type(f"{path}: column {name} is {values.dtype}; expected numbers.")
        columns[name] = values
    return columns
