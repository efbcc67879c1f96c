"""What a folder or file holds, as plain facts."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hdmap_tools.compare.mask_file import load_mask
from hdmap_tools.errors import FormatError
from hdmap_tools.formats.by_name import is_readable, read_vector_map
from hdmap_tools.fusion.cell_counts import TILE_CELLS
from hdmap_tools.fusion.semantic_map import SemanticMap, is_semantic_map
from hdmap_tools.readers.open_drive import open_drive


def describe(
    path: Path, layout: str = "auto", scene: str | None = None, cameras: Sequence[str] = ()
) -> dict[str, Any]:
    """Facts about a drive, a semantic map (or the folder of a run), a vector map, or a mask.

    Raises:
        HDMapError: If it is none of these, or cannot be read.
    """
    if not path.exists():
        raise FormatError(
            f"{path} does not exist; expected a drive, a semantic map, a vector map or a mask."
        )
    if path.is_file():
        suffix = path.suffix.lower()
        if suffix == ".png":
            return _describe_mask(path)
        if suffix == ".json":
            _refuse_figures(path)
        return _describe_vector_map(path)
    if is_semantic_map(path):
        return _describe_semantic_map(path)
    if is_semantic_map(path / "semantic_map"):
        return _describe_semantic_map(path / "semantic_map")
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
            {"path": str(p), "is_readable": p.suffix.lower() == ".png" or is_readable(p)}
            for p in drive.reference_maps
        ],
        "warnings": list(drive.warnings),
    }


def _describe_semantic_map(path: Path) -> dict[str, Any]:
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
