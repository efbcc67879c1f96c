"""Opening a drive as a configuration asks for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from hdmap_tools.config import Config
from hdmap_tools.errors import ConfigError, DriveError
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.readers.drive import Drive
from hdmap_tools.readers.open_drive import open_drive
from hdmap_tools.segmentation.open_segmenter import NAMED_MODELS


def open_configured(config: Config, drive_path: Path) -> Drive:
    """Open a drive as configured."""
    wanted = config.drive
    return open_drive(drive_path, wanted.layout, wanted.scene, wanted.cameras)


def open_for(config: Config, drive_path: Path) -> Drive:
    """Open a drive to be mapped: it has images, and its place on earth is settled."""
    drive = open_configured(config, drive_path)
    require_images(drive)
    origin = config.export.origin
    if origin is not None and drive.frame.is_georeferenced:
        raise ConfigError(
            f"Drive {drive.name} knows its place on earth ({drive.frame.describe()}); leave --origin out."
        )
    if origin is not None:
        drive = replace(drive, frame=MapFrame.from_origin(*origin))
    if config.export.formats and not drive.frame.is_georeferenced:
        _ = drive.frame.crs  # raises NoOriginError before hours of work, not after
    return drive


def with_absolute_paths(config: Config) -> Config:
    """The same configuration, with paths that hold from any working folder."""
    segmentation, association = config.segmentation, config.association
    model = segmentation.model
    if str(model) not in NAMED_MODELS:
        model = _absolute(model)
    return config.model_copy(
        update={
            "segmentation": segmentation.model_copy(
                update={"model": model, "labels": _absolute(segmentation.labels)}
            ),
            "association": association.model_copy(update={"points": _absolute(association.points)}),
            "observation": config.observation.model_copy(
                update={"confusion": _absolute(config.observation.confusion)}
            ),
            "compare": config.compare.model_copy(
                update={"reference": _absolute(config.compare.reference)}
            ),
        }
    )


def _absolute(path: Path | None) -> Path | None:
    return None if path is None else path.absolute()


def require_images(drive: Drive) -> None:
    """Raise `DriveError` if a drive has nothing to segment."""
    if not drive.images:
        raise DriveError(
            f"Drive {drive.name} has no images, so there is nothing to segment. Expected images of "
            f"{', '.join(drive.cameras) or 'a calibrated camera'} in {drive.root}."
        )
