"""The nuScenes tables, read for one scene without keeping the rest in memory.

Source:
    The data set's schema, https://www.nuscenes.org/nuscenes#data-format.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from hdmap_tools.errors import CalibrationError, DriveError

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
_TYPES: Final[dict[str, type]] = {
    "timestamp": int,
    "width": int,
    "height": int,
    "filename": str,
    "name": str,
    "location": str,
    "channel": str,
    "modality": str,
}
_CALIBRATION_TABLES: Final = frozenset({"calibrated_sensor", "sensor"})


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
            row lacks a column; `CalibrationError` for the tables of calibration.
    """
    error_type = CalibrationError if name in _CALIBRATION_TABLES else DriveError
    path, columns = folder / f"{name}.json", _COLUMNS[name]

    def filter_row(row: Row) -> Row | None:
        missing = [column for column in columns if column not in row]
        if missing:
            raise error_type(
                f"Table {path} has a row without {', '.join(missing)} (columns found: "
                f"{', '.join(sorted(row)) or 'none'}); expected {', '.join(columns)}."
            )
        try:
            wanted = keep(row)
        except TypeError:  # a token that cannot be looked up is no text: reported below
            wanted = True
        if not wanted:
            return None
        for column in columns:
            expected = _TYPES.get(column, str if column.endswith("token") else object)
            if not isinstance(row[column], expected):
                raise error_type(
                    f"Table {path} has {column} = {row[column]!r}; expected {expected.__name__}."
                )
        return row

    try:
        with path.open(encoding="utf-8") as file:
            rows = json.load(file, object_hook=filter_row)
    except FileNotFoundError as error:
        raise error_type(
            f"Table {path} is missing; expected the nuScenes tables {', '.join(_COLUMNS)} in one "
            "folder. Unpack the metadata archive of the data set again."
        ) from error
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise error_type(
            f"Table {path} is not valid JSON ({error}); it may be truncated. Unpack it again."
        ) from error
    except OSError as error:
        raise error_type(f"Table {path} cannot be read: {error.strerror or error}.") from error
    if not isinstance(rows, list) or any(not isinstance(row, dict) for row in rows if row):
        raise error_type(f"Table {path} is not a list of rows; expected [{{...}}, ...].")
    return [row for row in rows if row]


def by_token(rows: Sequence[Row]) -> dict[str, Row]:
    """Rows by their token."""
    return {row["token"]: row for row in rows}


def choose_scene(scenes: Sequence[Row], wanted: str | None, folder: Path) -> Row:
    """The scene of that name or token, or the only one.

    Raises:
        DriveError: If it does not exist, or several exist and none was named; the
            message lists the names.
    """
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
