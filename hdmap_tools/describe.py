"""What a folder or file holds, as plain facts."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from hdmap_tools.compare.mask_file import load_mask
from hdmap_tools.compare.reference import is_truth_raster
from hdmap_tools.errors import FormatError
from hdmap_tools.formats.by_name import is_readable, read_vector_map
from hdmap_tools.fusion.cell_counts import TILE_CELLS
from hdmap_tools.fusion.map_location import MapLocation
from hdmap_tools.fusion.map_store import is_semantic_map
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.point_map.point_files import is_point_file, read_point_file
from hdmap_tools.point_map.point_map import META_NAME, TILE_MM, PointMap
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.simulate.truth_files import SIMULATION_NAME, TRUTH_FOLDER


def describe(
    path: MapLocation, layout: str = "auto", scene: str | None = None, cameras: Sequence[str] = ()
) -> dict[str, Any]:
    """Facts about a drive, a semantic map (or the folder of a run), a point map, or a file.

    What lies in S3 is a semantic map. Files are vector maps, masks, and point clouds.

    Raises:
        HDMapError: If it is none of these, or cannot be read.
    """
    if not isinstance(path, Path):
        return _describe_semantic_map(path)
    if not path.exists():
        raise FormatError(
            f"{path} does not exist; expected a drive, a semantic map, a point map, a vector map or a mask."
        )
    if path.is_file():
        suffix = path.suffix.lower()
        if suffix == ".png":
            return _describe_mask(path)
        if suffix == ".json":
            _refuse_figures(path)
        if is_point_file(path):
            return _describe_point_cloud(path)
        return _describe_vector_map(path)
    if is_semantic_map(path):
        return _describe_semantic_map(path)
    if is_semantic_map(path / "semantic_map"):
        return _describe_semantic_map(path / "semantic_map")
    if (path / META_NAME).is_file() and (path / "tiles").is_dir():
        return _describe_point_map(path)
    return _describe_drive(path, layout, scene, cameras)


def _describe_drive(
    path: Path, layout: str, scene: str | None, cameras: Sequence[str]
) -> dict[str, Any]:
    drive = open_drive(path, layout, scene, cameras)
    images = Counter(image.camera for image in drive.images)
    times = drive.trajectory.timestamps_ns
    return {
        "kind": "drive",
        "drive": drive.id,
        "place": drive.frame.describe(),
        "poses": len(drive.trajectory),
        "duration_s": round(float(times[-1] - times[0]) / 1e9, 3),
        "length_m": round(drive.trajectory.length_m, 1),
        "sweeps": len(drive.sweeps),
        "images": len(drive.images),
        "cameras": {
            name: f"{camera.width_px} x {camera.height_px}, {images[name]} images"
            for name, camera in sorted(drive.cameras.items())
        },
        "reference_maps": [
            {"path": str(p), "is_readable": _is_reference(p)} for p in drive.reference_maps
        ],
        **_simulation(path),
        "warnings": list(drive.warnings),
    }


def _is_reference(path: Path) -> bool:
    """Whether `hdmap compare` takes it."""
    return path.suffix.lower() == ".png" or is_truth_raster(path) or is_readable(path)


def _simulation(path: Path) -> dict[str, Any]:
    """Of a simulated drive, how it was made."""
    document = path / TRUTH_FOLDER / SIMULATION_NAME
    if not document.is_file():
        return {}
    try:
        made = json.loads(document.read_bytes())
        settings = made["settings"]
        return {
            "simulated": {
                "world": str(made["world"]["name"]),
                **{name: settings[name] for name in _SHOWN_SETTINGS},
                "pose_errors": ", ".join(
                    f"{name} {value:g}" for name, value in settings["pose_errors"].items()
                ),
            }
        }
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise FormatError(
            f"{document} does not say how the drive was simulated ({type(error).__name__}: {error!s:.80}); copy "
            "the drive again, or remove the file."
        ) from error


_SHOWN_SETTINGS: Final = ("seed", "weather", "difficulty", "lidar", "calibration_error_m")


def _describe_point_map(path: Path) -> dict[str, Any]:
    point_map = PointMap.open(path)
    meta, tiles = point_map.meta, point_map.tile_indices()
    tile_m2 = (TILE_MM / 1000.0) ** 2
    return {
        "kind": "point map",
        "place": meta.frame.describe(),
        "made_from": meta.source,
        "points": point_map.num_points,
        "tiles": f"{len(tiles)} ({len(tiles) * tile_m2:.0f} m2)",
        "bounds_m": _bounds(point_map.bounds_m),
        "voxel_m": meta.voxel_mm / 1000.0,
        "cell_m": meta.cell_mm / 1000.0,
        "asphalt_intensity": meta.asphalt_intensity,
        "drives": {
            drive.id: f"{drive.num_sweeps} sweeps, poses {'refined' if drive.is_refined else 'as given'}"
            for drive in meta.drives
        },
    }


def _describe_point_cloud(path: Path) -> dict[str, Any]:
    cloud = read_point_file(path)
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    return {
        "kind": "point cloud",
        "place": "not known" if cloud.crs is None else cloud.crs.name,
        "points": len(cloud),
        "left_out": f"{cloud.num_dropped} points that are NaN, infinite or not of this earth",
        "intensity": cloud.intensity is not None,
        "ground": "not marked" if cloud.is_ground is None else f"{cloud.is_ground.mean():.1%}",
        "bounds_m": _bounds((*low[:2].tolist(), *high[:2].tolist())),
        "height_m": f"{low[2]:.2f} to {high[2]:.2f}",
    }


def _describe_semantic_map(path: MapLocation) -> dict[str, Any]:
    semantic_map = SemanticMap.open(path)
    meta, tiles = semantic_map.meta, semantic_map.tile_indices()
    tile_m2 = (TILE_CELLS * meta.resolution_m) ** 2
    return {
        "kind": "semantic map",
        "place": meta.frame.describe(),
        "resolution_m": meta.resolution_m,
        "labels": f"{meta.label_set.name}: {', '.join(meta.label_set.names)}",
        "model": meta.model,
        "count_mode": meta.count_mode,
        "intensity_threshold": meta.intensity_threshold,
        "tiles": f"{len(tiles)} ({len(tiles) * tile_m2:.0f} m2)",
        "drives": {name: f"{d['num_frames']} images" for name, d in semantic_map.drives.items()},
        "history": [
            f"{version.time:%Y-%m-%d %H:%M:%S}  {version.id}  {version.message}"
            for version in semantic_map.history()
        ],
    }


def _describe_vector_map(path: Path) -> dict[str, Any]:
    vector_map = read_vector_map(path)
    return {
        "kind": "vector map",
        "place": vector_map.frame.describe(),
        "elements": vector_map.counts(),
        "bounds_m": _bounds(vector_map.bounds_m),
        "provenance": vector_map.provenance,
    }


def _describe_mask(path: Path) -> dict[str, Any]:
    mask = load_mask(path)
    width, height = mask.sidecar.size_px
    return {
        "kind": "mask",
        "place": mask.frame.describe(),
        "classes": ", ".join(mask.sidecar.classes),
        "resolution_m": mask.sidecar.resolution_m,
        "size": f"{width} x {height} pixels",
        "marked": f"{mask.is_marked.mean():.1%}",
        "bounds_m": _bounds(mask.bounds_m),
    }


def _bounds(bounds_m: Sequence[float] | None) -> dict[str, float]:
    names = ("west", "south", "east", "north")
    return {name: round(b, 2) for name, b in zip(names, bounds_m or (), strict=False)}


def _refuse_figures(path: Path) -> None:
    """A run's metrics.json lies beside its maps, and is none."""
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return  # the reader says what is wrong with it
    if isinstance(document, dict) and {"num_elements", "comparisons"} <= document.keys():
        raise FormatError(
            f"{path} holds the figures of a run, not a map; open it as it is, or ask for info on its "
            f"folder {path.parent}."
        )
