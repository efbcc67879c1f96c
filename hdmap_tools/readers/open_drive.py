"""Open a drive of any known layout from a path."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from hdmap_tools.errors import DriveError
from hdmap_tools.readers import av2, nuscenes
from hdmap_tools.readers.drive import Drive
from hdmap_tools.readers.folders import os_errors_are_drive_errors, require_listable
from hdmap_tools.readers.nuscenes_tables import find_version_folders

_SIMULATION_NAME: Final = "simulation.json"
"""Lies beside the true poses in `truth/` of a simulated drive."""


@dataclass(frozen=True)
class Layout:
    """One way in which drives lie on disk.

    Attributes:
        name: What `open_drive` and ``--layout`` call it.
        signature: What its folder is recognized by, for messages.
        find: Drives (or data roots) of this layout at or below a folder.
        read: Reads (path, scene, cameras).
    """

    name: str
    signature: str
    find: Callable[[Path], list[Path]]
    read: Callable[[Path, str | None, Sequence[str]], Drive]


def open_drive(
    path: Path, layout: str = "auto", scene: str | None = None, cameras: Sequence[str] = ()
) -> Drive:
    """Open the drive at a path.

    Args:
        path: Folder of a drive, or a data root that contains one.
        layout: A key of `LAYOUTS`, or ``auto`` to recognize it by its files.
        scene: Which drive of a data root: a nuScenes scene's name or token, or an
            Argoverse 2 log's folder name; may be None if there is only one.
        cameras: Camera names; empty means all that can be used.

    Raises:
        DriveError: If the path does not exist, its layout is unknown or not clear,
            the scene does not exist, or the drive cannot be read.
    """
    with os_errors_are_drive_errors():
        return _open_drive(Path(path), layout, scene, cameras)


def _open_drive(path: Path, layout: str, scene: str | None, cameras: Sequence[str]) -> Drive:
    if not path.exists():
        raise DriveError(f"{path} does not exist; expected the folder of a drive.")
    if not path.is_dir():
        raise DriveError(f"{path} is a file; expected the folder of a drive.")
    if layout != "auto":
        if layout not in LAYOUTS:
            raise DriveError(
                f"Layout {layout!r} is unknown; use auto or one of {', '.join(LAYOUTS)}."
            )
        return LAYOUTS[layout].read(path, scene, cameras)
    fitting = [candidate for candidate in LAYOUTS.values() if candidate.find(path)]
    if len(fitting) == 1:
        return fitting[0].read(path, scene, cameras)
    looked_for = "; ".join(f"{c.name}: {c.signature}" for c in LAYOUTS.values())
    if not fitting:
        require_listable(path)
        content = "is empty" if not any(path.iterdir()) else "holds no known drive"
        raise DriveError(
            f"{path} {content}. Looked for {looked_for}. Give the drive's own folder, or its layout."
        )
    raise DriveError(
        f"{path} holds drives of several layouts ({', '.join(c.name for c in fitting)}); choose one "
        "with --layout."
    )


def _find_av2(path: Path) -> list[Path]:
    if (path / av2.POSES_FILE).is_file():
        return [path]
    # A data root holds logs, or a folder for each split (train, val, test) of them.
    for pattern in (f"*/{av2.POSES_FILE}", f"*/*/{av2.POSES_FILE}"):
        found = sorted(file.parent for file in path.glob(pattern))
        # A simulated drive's true poses are no drive of their own.
        if found := [folder for folder in found if not (folder / _SIMULATION_NAME).is_file()]:
            return found
    return []


def _read_av2(path: Path, scene: str | None, cameras: Sequence[str]) -> Drive:
    logs = _find_av2(path)
    if not logs:
        require_listable(path)
        raise DriveError(
            f"{path} holds no Argoverse 2 log: looked for {LAYOUTS[av2.LAYOUT].signature}."
        )
    names = [log.resolve().name for log in logs]
    listing = ", ".join(names[:20]) + (f", … ({len(names)} in all)" if len(names) > 20 else "")
    if scene is None and len(logs) > 1:
        raise DriveError(
            f"{path} holds {len(logs)} logs; give one's folder or choose it by name (--scene): "
            f"{listing}."
        )
    chosen = [log for log, name in zip(logs, names, strict=True) if scene in (None, name)]
    if not chosen:
        raise DriveError(f"{path} has no log {scene!r}; it has: {listing}.")
    return av2.read_av2(chosen[0], cameras)


LAYOUTS: Final[Mapping[str, Layout]] = {
    layout.name: layout
    for layout in (
        Layout(
            av2.LAYOUT,
            f"{av2.POSES_FILE} in it or in a folder of it",
            _find_av2,
            _read_av2,
        ),
        Layout(
            nuscenes.LAYOUT,
            "scene.json in it or in a folder of it (v1.0-mini, v1.0-trainval, ...)",
            find_version_folders,
            nuscenes.read_nuscenes,
        ),
    )
}
"""Every layout that can be read, by name."""
