"""Pictures of an evaluation: the maps beside the truth, the local map beside the global one, reliability."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.compare.paper import NO_TRUTH
from hdmap_tools.compare.reliability import ReliabilityReport
from hdmap_tools.evaluate.experiment import Evaluated
from hdmap_tools.evaluate.methods import OUR_MAP
from hdmap_tools.frame_source import FrameSource, frame_key
from hdmap_tools.fusion.local_map import LocalMap
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import MAP_CLASSES, MapClass
from hdmap_tools.plugin_api import MapWindow
from hdmap_tools.readers.drive import ImageRef
from hdmap_tools.readers.image import read_image
from hdmap_tools.segmentation.cache import LabelCache, segment_drive
from hdmap_tools.segmentation.open_segmenter import open_segmenter
from hdmap_tools.types import NDArrayInt
from hdmap_tools.view.local_and_global import local_and_global_picture
from hdmap_tools.view.overview import CameraPicture, Panel, known_bounds, overview_picture
from hdmap_tools.view.reliability_diagram import reliability_picture

WHOLE_NAME: Final = "maps.png"
CLOSE_NAME: Final = "close.png"
LOCAL_NAME: Final = "local_and_global.png"
RELIABILITY_NAME: Final = "reliability.png"

_CLOSE_M: Final = 35.0
_BEFORE: Final = 40
"""Images that a local map is made of; those further back lie behind it."""


def draw_pictures(evaluated: Evaluated, folder: Path, cache: LabelCache | None) -> None:
    """Write all pictures of an evaluation into a folder."""
    windows = evaluated.windows
    ours = windows["ours"]
    truth = truth_window(evaluated.truth, ours.grid)
    names = ("Vanilla", "CFN", "ours")
    panels = [Panel("truth", truth), *(Panel(name, windows[name]) for name in names)]
    path = evaluated.drive.trajectory.translations
    image, pose = place_of_interest(evaluated)
    title = f"{evaluated.evaluation.drive} (simulated)"
    overview_picture(
        folder / WHOLE_NAME,
        [panels[0], panels[-1]],
        trajectory_xy=path,
        bounds_m=known_bounds([ours]),
        title=title,
    )
    x, y = pose.transform_from(np.array([[10.0, 0.0, 0.0]]))[0, :2]
    photo = read_image(image, evaluated.drive.cameras[image.camera])
    overview_picture(
        folder / CLOSE_NAME,
        panels,
        images=[CameraPicture(image.key, photo)],
        trajectory_xy=path,
        city_SE3_ego=pose,
        bounds_m=(x - _CLOSE_M, y - _CLOSE_M, x + _CLOSE_M, y + _CLOSE_M),
        title=title,
    )
    _draw_local(evaluated, folder / LOCAL_NAME, image, pose, cache)
    evaluation = evaluated.evaluation
    reliability_picture(
        ReliabilityReport(
            truth=evaluation.drive,
            classes=ours.classes,
            temperature=evaluation.temperature,
            temperature_before=1.0,
            num_cells_fitted=0,
            before=evaluation.reliability_before,
            after=evaluation.reliability_after,
            rule="fitted on another drive",
        ),
        folder / RELIABILITY_NAME,
    )


def truth_window(truth: NDArrayInt, grid: BevGrid) -> MapWindow:
    """The truth as a map that is certain: (y, x) index into the map classes and ``other``."""
    import xarray as xr

    names = [*(str(c) for c in MAP_CLASSES), "other"]
    known = truth != NO_TRUTH
    posterior = np.full((len(names), *grid.shape), np.nan, dtype=np.float32)
    posterior[:, known] = (np.arange(len(names))[:, None] == truth[known]).astype(np.float32)
    nothing = np.full(grid.shape, np.nan, dtype=np.float32)
    return MapWindow(
        xr.Dataset(
            {
                "posterior": (("class", "y", "x"), posterior),
                "entropy": (("y", "x"), np.where(known, 0.0, np.nan).astype(np.float32)),
                "observations": (("y", "x"), known.astype(np.float32)),
                "intensity": (("y", "x"), nothing),
                "height": (("y", "x"), nothing),
            },
            coords={"class": names, "y": grid.y_centres_m, "x": grid.x_centres_m},
        ),
        grid,
    )


def place_of_interest(evaluated: Evaluated) -> tuple[ImageRef, SE3]:
    """The image with most true crosswalk and paint in the 25 m before it, and its pose."""
    grid = evaluated.windows["ours"].grid
    drive = evaluated.drive
    wanted = [MAP_CLASSES.index(c) for c in (MapClass.CROSSWALK, MapClass.LANE_MARK)]
    rows, cols = np.nonzero(np.isin(evaluated.truth, wanted) & evaluated.mask)
    weight = np.where(evaluated.truth[rows, cols] == wanted[1], 1.0, 0.5)
    xy = grid.to_city(np.column_stack([rows, cols]).astype(np.float64))
    best: tuple[float, ImageRef, SE3] | None = None
    for image in drive.images[:: max(len(drive.images) // 100, 1)]:
        pose = drive.trajectory.interpolate(
            image.timestamp_ns, evaluated.config.drive.max_pose_gap_s
        )
        ahead = pose.inverse().transform_from(
            np.column_stack([xy, np.full(len(xy), pose.translation[2])])
        )
        inside = (ahead[:, 0] > 5.0) & (ahead[:, 0] < 25.0) & (np.abs(ahead[:, 1]) < 8.0)
        score = float(weight[inside].sum())
        if best is None or score > best[0]:
            best = score, image, pose
    assert best is not None
    return best[1], best[2]


def _draw_local(
    evaluated: Evaluated, path: Path, image: ImageRef, pose: SE3, cache: LabelCache | None
) -> None:
    """The local map as it was when an image was taken, beside the finished global one."""
    drive, config = evaluated.drive, evaluated.config
    dense = config.association.model_copy(update={"method": "dense", "also": ()})
    meta = evaluated.maps[OUR_MAP].meta
    fusion = config.fusion.model_copy(update={"range_edges_m": meta.range_edges_m})
    config = config.model_copy(update={"association": dense, "fusion": fusion})
    source = FrameSource(drive, config)
    segmenter = open_segmenter(config.segmentation, drive)
    local = LocalMap(meta)
    until = drive.images.index(image) + 1
    for one, labels in segment_drive(
        drive, segmenter, drive.images[max(until - _BEFORE, 0) : until], cache
    ):
        seen = source.observe("dense", one, labels, meta.label_set, meta.resolution_m)
        local.update(seen, source.pose(one.timestamp_ns), frame_key(one))
    assert local.city_SE3_local is not None
    camera = drive.cameras[image.camera]
    local_and_global_picture(
        path,
        CameraPicture(image.key, read_image(image, camera)),
        local.window(evaluated.models["ours"], 1),
        local.city_SE3_local,
        evaluated.windows["ours"],
        pose,
        trajectory_xy=drive.trajectory.translations,
        title="Local and global map of one place (simulated)",
    )
