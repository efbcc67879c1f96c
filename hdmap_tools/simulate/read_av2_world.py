"""An Argoverse 2 map as a world."""

from __future__ import annotations

from pathlib import Path

from hdmap_tools.errors import WorldError
from hdmap_tools.simulate.world_map import WorldMap


def find_av2_map(path: Path) -> Path:
    """The map file of a log folder, a map folder, or the file itself."""
    if path.is_file():
        return path
    found = sorted(path.glob("log_map_archive_*.json")) + sorted(
        path.glob("map/log_map_archive_*.json")
    )
    if len(found) != 1:
        raise WorldError(
            f"{path} holds {len(found)} files log_map_archive_*.json; expected one, in the folder "
            "or in its folder 'map'."
        )
    return found[0]


def read_av2_world(path: Path, origin: tuple[float, float, float] | None = None) -> WorldMap:
    """Read the vector map of an Argoverse 2 log."""
    raise WorldError(f"{path}: Argoverse 2 maps are not read yet.")
