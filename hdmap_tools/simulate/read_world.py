"""Opening a map as a world: which reader a file is for, and the worlds that ship with the package."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from hdmap_tools.errors import WorldError
from hdmap_tools.simulate.read_av2_world import find_av2_map, read_av2_world
from hdmap_tools.simulate.read_lanelet2_world import read_lanelet2_world
from hdmap_tools.simulate.world_map import WorldMap

_WORLDS: Final = Path(__file__).parent / "worlds"


def read_world(path: Path, origin: tuple[float, float, float] | None = None) -> WorldMap:
    """Read a map as a world to drive through.

    Args:
        path: A Lanelet2 file (``.osm``), an Argoverse 2 ``log_map_archive_*.json``, or the
            log or map folder that holds one.
        origin: Latitude, longitude (degrees) and height (metres) of the city frame; by
            default the middle of a Lanelet2 file, or the city of an Argoverse 2 map.

    Returns:
        The world, with at least one road lane.

    Raises:
        FormatError: If the file is damaged.
        WorldError: If there is no such file, it is no map that can be read, it has no road
            lanes, or its place on earth is unknown and `origin` is not given.
    """
    path = Path(path)
    if not path.exists():
        raise WorldError(
            f"There is no map at {path}; expected a Lanelet2 file (.osm) or an Argoverse 2 map "
            "(log_map_archive_*.json, or a folder with one). With the package come: "
            f"{', '.join(shipped_worlds())}."
        )
    if path.is_dir() or path.suffix.lower() == ".json":
        world = read_av2_world(find_av2_map(path), origin)
    elif path.suffix.lower() == ".osm":
        world = read_lanelet2_world(path, origin)
    else:
        raise WorldError(
            f"{path} is none of the maps a world can be made of; expected a Lanelet2 file (.osm) "
            "or an Argoverse 2 map (log_map_archive_*.json, or a folder with one)."
        )
    if not any(lane.kind == "road" for lane in world.lanes.values()):
        found = f"{len(world.lanes)} lanes, none of them" if world.lanes else "no lanes"
        raise WorldError(
            f"{path} has {found} for vehicles, so there is nothing to drive on; expected road "
            "lanelets (Lanelet2: type=lanelet, subtype=road) or lane segments (Argoverse 2)."
        )
    return world


def shipped_worlds() -> list[str]:
    """Names of the worlds that come with the package."""
    return sorted(path.stem for path in _WORLDS.glob("*.osm"))


def shipped_world(name: str = "demo_town") -> Path:
    """The file of a world that comes with the package.

    Raises:
        WorldError: If there is none of that name.
    """
    if name not in shipped_worlds():
        raise WorldError(
            f"No world called {name!r} comes with the package; there are: "
            f"{', '.join(shipped_worlds())}."
        )
    return _WORLDS / f"{name}.osm"
