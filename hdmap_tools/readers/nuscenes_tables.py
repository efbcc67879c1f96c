"""The nuScenes tables, read for one scene without keeping the rest in memory.

Source:
    The data set's schema, https://www.nuscenes.org/nuscenes#data-format.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from hdmap_tools.errors import CalibrationError, DriveError, PoseError
from hdmap_tools.readers.checks import (
    MAX_IMAGE_PX,
    MAX_TIME_NS,
    name_problem,
    shown,
    shown_names,
    text_problem,
)
from hdmap_tools.readers.folders import require_listable

Row = dict[str, Any]

_COLUMNS: Final = {
    "scene": ("token", "name", "log_token"),
    "log": ("token", "location"),
    "sample": ("token", "scene_token"),
    "sample_data": (
        "token",
        "sample_token",
        "ego_pose_token",
        "calibrated_sensor_token",
        "timestamp",
        "filename",
        "width",
        "height",
    ),
    "ego_pose": ("token", "timestamp", "rotation", "translation"),
    "calibrated_sensor": ("token", "sensor_token", "rotation", "translation", "camera_intrinsic"),
    "sensor": ("token", "channel", "modality"),
}
_WHOLE_NUMBERS: Final[Mapping[str, int]] = {
    "timestamp": MAX_TIME_NS // 1000,
    "width": MAX_IMAGE_PX,
    "height": MAX_IMAGE_PX,
}
"""Columns of whole numbers from 0 to below a limit."""

_TEXTS: Final = frozenset({"filename", "name", "location", "channel", "modality"})
_MAX_FILENAME: Final = 1024
_MAX_NAME: Final = 255
_MAX_DIGITS: Final = 30
_UNWANTED: Final = object()

_ERROR_TYPES: Final[Mapping[str, type[DriveError]]] = {
    "ego_pose": PoseError,
    "calibrated_sensor": CalibrationError,
    "sensor": CalibrationError,
}


class _LongNumber:
    """Stands for a whole number that no column can hold; Python refuses 4301 digits, slowly."""

    def __init__(self, digits: str) -> None:
        self._num_digits = len(digits.lstrip("-"))

    def __repr__(self) -> str:
        return f"<a whole number of {self._num_digits} digits>"


def _whole_number(digits: str) -> int | _LongNumber:
    return int(digits) if len(digits) <= _MAX_DIGITS else _LongNumber(digits)


def error_type_of(table: str) -> type[DriveError]:
    """What a problem of that table is raised as."""
    return _ERROR_TYPES.get(table, DriveError)


def find_version_folders(root: Path) -> list[Path]:
    """Folders with nuScenes tables: root itself if it holds ``scene.json``, else those inside."""
    if (root / "scene.json").is_file():
        return [root]
    if not root.is_dir():
        return []
    return sorted(f.parent for f in root.glob("*/scene.json") if f.is_file())


def choose_version_folder(root: Path, version: str | None) -> Path:
    """The one folder of tables to read.

    Raises:
        DriveError: If there is none, or several and none was chosen.
    """
    folders = find_version_folders(root)
    names = ", ".join(folder.name for folder in folders)
    if version is not None:
        folders = [folder for folder in folders if folder.name == version]
    if len(folders) == 1:
        return folders[0]
    if not names:
        require_listable(root)
        raise DriveError(
            f"{root} holds no nuScenes tables: looked for scene.json in it and in its folders "
            "(v1.0-mini, v1.0-trainval, ...). Give the folder that contains samples/ and v1.0-*/."
        )
    if version is not None:
        raise DriveError(f"{root} has no version {version!r} of the tables; it has {names}.")
    raise DriveError(
        f"{root} holds several versions of the tables ({names}); choose one by its folder, for "
        f"example {folders[0]}."
    )


def read_table(
    folder: Path, name: str, keep: Callable[[Row], bool] = lambda row: True
) -> list[Row]:
    """The rows of one table that are wanted.

    Unwanted rows are dropped while the file is parsed: sample_data and ego_pose of
    v1.0-trainval have 2.6 million rows each, of which one scene needs thousands.

    Args:
        folder: Folder of the tables.
        name: Table name without ``.json``.
        keep: Says whether a row is wanted.

    Raises:
        DriveError: If the file is missing, is not JSON, is not a list of rows, or a
            row lacks a column or holds what the column cannot; as `CalibrationError` or
            `PoseError` for the tables of these.
    """
    error_type = error_type_of(name)
    path, columns = folder / f"{name}.json", _COLUMNS[name]

    def filter_row(row: Row) -> object:
        if any(column not in row for column in columns):
            return row  # no row, or a broken one: reported below, with its number
        try:
            return row if keep(row) else _UNWANTED
        except TypeError:  # a token that cannot be looked up is no text: reported below
            return row

    try:
        with path.open(encoding="utf-8") as file:
            rows = json.load(file, object_hook=filter_row, parse_int=_whole_number)
    except FileNotFoundError as error:
        raise error_type(
            f"Table {path} is missing; expected the nuScenes tables {', '.join(_COLUMNS)} in one "
            "folder. Unpack the metadata archive of the data set again."
        ) from error
    except (ValueError, RecursionError) as error:
        problem = "nested too deeply" if isinstance(error, RecursionError) else str(error)
        raise error_type(
            f"Table {path} is not valid JSON ({problem}); it may be truncated. Unpack it again."
        ) from error
    except OSError as error:
        raise error_type(f"Table {path} cannot be read: {error.strerror or error}.") from error
    if not isinstance(rows, list):
        raise error_type(f"Table {path} is not a list of rows; expected [{{...}}, ...].")
    wanted = []
    for number, row in enumerate(rows):
        if row is _UNWANTED:
            continue
        if not isinstance(row, dict):
            raise error_type(
                f"Table {path} is not a list of rows; expected [{{...}}, ...], found {shown(row)} "
                f"as row {number}."
            )
        if (found_expected := _row_problem(row, columns)) is not None:
            found, expected = found_expected
            raise error_type(
                f"Table {path} has {found} at {row_name(row, number)}; expected {expected}."
            )
        wanted.append(row)
    return wanted


def _row_problem(row: Row, columns: Sequence[str]) -> tuple[str, str] | None:
    """What was found in a row and what was expected; None if all is well."""
    if missing := [column for column in columns if column not in row]:
        found = f"a row without {', '.join(missing)} (columns found: {shown_names(sorted(row))})"
        return found, ", ".join(columns)
    for column in columns:
        expected = _expected_instead(column, row[column])
        if expected is not None:
            return f"{column} = {shown(row[column])}", expected
    return None


def _expected_instead(column: str, value: object) -> str | None:
    """What a column should hold instead of a value; None if the value can stand."""
    if (limit := _WHOLE_NUMBERS.get(column)) is not None:
        if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < limit:
            return None
        return f"a whole number from 0 to {limit - 1}"
    if column not in _TEXTS and not column.endswith("token"):
        return None
    if not isinstance(value, str):
        return "a text"
    if column == "channel":
        return name_problem(value)
    return text_problem(value, _MAX_FILENAME if column == "filename" else _MAX_NAME)


def row_name(row: Row, number: int | None = None) -> str:
    """What to call a row in messages: its number in the file, if known, and its token."""
    token = f"token {shown(row.get('token'))}"
    return f"the row of {token}" if number is None else f"row {number} ({token})"


def by_token(
    rows: Sequence[Row], table: str, folder: Path, warnings: list[str] | None = None
) -> dict[str, Row]:
    """Rows by their token; a row that stands there twice is taken once.

    Args:
        rows: Rows of the table.
        table: Its name, for messages.
        folder: Folder of the tables.
        warnings: Receives how many rows were repeated.

    Raises:
        DriveError: If two rows of one token differ in a column that is read; as
            another type for tables that have their own.
    """
    found: dict[str, Row] = {}
    for row in rows:
        first = found.setdefault(row["token"], row)
        differing = [c for c in _COLUMNS[table] if first is not row and first[c] != row[c]]
        if differing:
            column = differing[0]
            raise error_type_of(table)(
                f"Table {folder / table}.json has two rows with token {shown(row['token'])} that "
                f"contradict each other: {column} is {shown(first[column])} and "
                f"{shown(row[column])}. Unpack the metadata again."
            )
    if warnings is not None and (num_repeated := len(rows) - len(found)):
        warnings.append(
            f"{num_repeated} rows of {table}.json repeat another one and were taken once"
        )
    return found


def choose_scene(scenes: Sequence[Row], wanted: str | None, folder: Path) -> Row:
    """The scene of that name or token, or the only one.

    Raises:
        DriveError: If it does not exist, or several exist and none was named; the
            message lists the names.
    """
    scenes = list(by_token(scenes, "scene", folder).values())
    names = [str(row["name"]) for row in scenes]
    listing = ", ".join(names[:20]) + (f", … ({len(names)} in all)" if len(names) > 20 else "")
    if not scenes:
        raise DriveError(f"Table {folder / 'scene.json'} has no scenes; expected at least one.")
    if wanted is None:
        if len(scenes) > 1:
            raise DriveError(
                f"{folder} holds {len(scenes)} scenes; choose one by name or token (--scene): "
                f"{listing}."
            )
        return scenes[0]
    found = [row for row in scenes if wanted in (row["name"], row["token"])]
    if len(found) != 1:
        problem = "no scene" if not found else f"{len(found)} scenes called"
        raise DriveError(f"{folder} has {problem} {wanted!r}; it has: {listing}.")
    return found[0]
