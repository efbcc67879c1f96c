"""The `truth/` folder of a simulated drive: what nobody who drives for real ever has."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from hdmap_tools import __version__
from hdmap_tools.geometry.camera import PinholeCamera
from hdmap_tools.labels.label_set import LabelSet, load_label_set
from hdmap_tools.segmentation.label_png import write_label_png
from hdmap_tools.segmentation.precomputed import LABEL_SET_NAME, MODEL_NAME
from hdmap_tools.simulate.route import Route
from hdmap_tools.simulate.sensor_rigs import LidarModel
from hdmap_tools.simulate.settings import SimulationSettings
from hdmap_tools.simulate.world_map import WorldMap
from hdmap_tools.simulate.write_log import write_json
from hdmap_tools.types import NDArrayByte

TRUTH_FOLDER: Final = "truth"
SIMULATION_NAME: Final = "simulation.json"
LABEL_IMAGES: Final = "label_images"
LABEL_SET: Final = "paz2020"
"""Label set of all true label images."""
TRUE_LABELS: Final = "truth"
"""What made the true label images, where a model's name is asked for."""


def true_label_set() -> LabelSet:
    """What the ids in true label images mean."""
    return load_label_set(LABEL_SET)


def write_label_folder_head(truth: Path) -> None:
    """What the ids in the label images mean and what made them, so that ``--labels`` knows."""
    folder = truth / LABEL_IMAGES
    folder.mkdir(parents=True, exist_ok=True)
    document = true_label_set().model_dump_json(indent=2) + "\n"
    (folder / LABEL_SET_NAME).write_text(document, encoding="utf-8")
    write_json(folder / MODEL_NAME, {"model": TRUE_LABELS})


def write_true_labels(truth: Path, camera: str, timestamp_ns: int, labels: NDArrayByte) -> None:
    """One label image (H, W) uint8, ids of `LABEL_SET`."""
    write_label_png(truth / LABEL_IMAGES / camera / f"{timestamp_ns}.png", labels)


def simulation_document(
    world_path: Path,
    world: WorldMap,
    route: Route,
    settings: SimulationSettings,
    cameras: Sequence[PinholeCamera],
    lidar: LidarModel | None,
) -> dict[str, Any]:
    """How the drive was made: settings, world, route, and the true calibration."""
    return {
        "schema_version": 1,
        "made_by": f"hdmap_tools {__version__}",
        "settings": settings.model_dump(mode="json"),
        "world": {"name": world.name, "sha256": _hash_of(world_path)},
        "route": {
            "lane_ids": list(route.lane_ids),
            "length_m": round((len(route.xy) - 1) * route.step_m, 3),
        },
        "label_set": LABEL_SET,
        "ego_SE3_sensor": {
            **{camera.name: camera.ego_SE3_cam.matrix.tolist() for camera in cameras},
            **({lidar.name: lidar.ego_SE3_lidar.matrix.tolist()} if lidar is not None else {}),
        },
        "intrinsics": {camera.name: camera.matrix.tolist() for camera in cameras},
    }


def _hash_of(path: Path) -> str | None:
    """Of a file; a folder's map is not one file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
