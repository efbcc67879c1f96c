"""What a map is held against: truth cells on the map's own grid, from a mask or a vector map.

Whatever the reference is, it is sampled onto the map's grid once, here; everything
behind it compares cells with cells.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from hdmap_tools.compare.mask_file import Mask, load_mask
from hdmap_tools.errors import CRSMismatchError, FormatError, LabelError, ShapeError
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.geometry.map_frame import MapFrame
from hdmap_tools.labels.label_set import DRIVABLE_CLASSES, MapClass
from hdmap_tools.types import NDArrayBool, NDArrayFloat, NDArrayInt

logger = logging.getLogger(__name__)

DRIVABLE_GROUP: Final = "drivable"
"""Name of the union road, crosswalk, lane mark."""

SHARE_TOLERANCE: Final = 1e-6
"""Shares are sums of products of decimal lengths; half a cell must count as half."""


@dataclass(frozen=True, eq=False)
class ReferenceGroup:
    """Truth about one class, or about a union of classes that is not told apart.

    Attributes:
        name: The class, ``drivable``, or the class names joined with ``+``.
        classes: Map classes of the union.
        truth: (y, x) bool, rows going north.
    """

    name: str
    classes: tuple[MapClass, ...]
    truth: NDArrayBool


@dataclass(frozen=True, eq=False)
class Reference:
    """Truth cells on a map's grid.

    Attributes:
        grid: The cells.
        groups: What it speaks about, names unique.
        is_covered: (y, x) bool: cells about which the reference says anything.
        source: Name of the file or map.
        rule: When a cell is truth, in words.
        notes: What a reader of the figures should know, one line each.
    """

    grid: BevGrid
    groups: tuple[ReferenceGroup, ...]
    is_covered: NDArrayBool
    source: str
    rule: str
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for array in (self.is_covered, *(group.truth for group in self.groups)):
            if array.shape != self.grid.shape or array.dtype != np.bool_:
                raise ShapeError(
                    f"Reference arrays must be bool of the grid's shape {self.grid.shape}, found "
                    f"{array.dtype} {array.shape}."
                )
        names = [group.name for group in self.groups]
        if not names or len(set(names)) != len(names):
            raise ShapeError(f"A reference needs groups with unique names, found {names}.")

    def group(self, name: str) -> ReferenceGroup:
        """The group of that name.

        Raises:
            LabelError: If there is none; the message lists those there are.
        """
        for group in self.groups:
            if group.name == name:
                return group
        raise LabelError(
            f"Reference {self.source} has no group {name!r}; it has "
            f"{', '.join(group.name for group in self.groups)}."
        )


def load_reference(
    path: Path,
    grid: BevGrid,
    *,
    min_share: float = 0.5,
    classes: Sequence[MapClass] | None = None,
    assume_same_frame: bool = False,
) -> Reference:
    """Read a mask picture, a vector map or a truth raster and sample it onto a grid.

    Args:
        path: ``NAME.png`` with ``NAME.json`` beside it, a vector map in any format
            that the package reads, or the folder ``truth/raster`` of a simulated drive.
        grid: The map's grid.
        min_share: Share of a cell that must be marked for it to be truth; 0 means
            any part at all.
        classes: What a mask marks, instead of what its JSON says.
        assume_same_frame: Take the reference's metres as the map's own when only
            one of the two knows its place on earth.

    Raises:
        FormatError: If the file cannot be read, or does not overlap the grid.
        CRSMismatchError: If its place relative to the map cannot be known.
    """
    if is_truth_raster(path):
        from hdmap_tools.compare.truth_reference import reference_from_truth_raster

        return reference_from_truth_raster(path, grid)
    if path.suffix.lower() == ".png":
        return reference_from_mask(
            load_mask(path),
            grid,
            source=path.name,
            min_share=min_share,
            classes=classes,
            assume_same_frame=assume_same_frame,
        )
    from hdmap_tools.compare.vector_reference import reference_from_vector_map
    from hdmap_tools.formats.by_name import read_vector_map

    return reference_from_vector_map(
        # In the file's own frame: how that reaches the map's is decided and told here.
        read_vector_map(path),
        grid,
        source=path.name,
        min_share=min_share,
        assume_same_frame=assume_same_frame,
    )


def load_references(path: Path, grids: Mapping[str, BevGrid]) -> dict[str, Reference]:
    """`load_reference` for several maps of one lattice, by name.

    A truth raster, which takes the longest, is read once for all.

    Raises:
        HDMapError: As `load_reference`.
    """
    if grids and is_truth_raster(path):
        from hdmap_tools.compare.truth_reference import references_from_truth_raster

        made = references_from_truth_raster(path, list(grids.values()))
        return dict(zip(grids, made, strict=True))
    return {name: load_reference(path, grid) for name, grid in grids.items()}


def is_truth_raster(path: Path) -> bool:
    """Whether a folder is the truth raster of a simulated drive."""
    return path.is_dir() and (path / "index.json").is_file()


def reference_from_mask(
    mask: Mask,
    grid: BevGrid,
    *,
    source: str = "mask",
    min_share: float = 0.5,
    classes: Sequence[MapClass] | None = None,
    assume_same_frame: bool = False,
) -> Reference:
    """Sample a mask onto a grid.

    In one frame the marked share of each cell is exact for any ratio of sizes and any
    offset. Between two frames on earth it is counted on sub-cell points taken through WGS84.
    A cell that sticks out of the mask is not covered.

    Raises:
        CRSMismatchError: If only one of the two knows its place on earth.
        FormatError: If they do not overlap.
    """
    relation = frame_relation(mask.frame, grid.frame, source, assume_same_frame)
    if relation.through_wgs84:
        share, covered = _share_through_wgs84(mask, grid)
    else:
        share, covered = _share_in_one_frame(mask, grid)
    if not covered.any():
        raise no_overlap(source, mask.bounds_m, grid)
    marked = tuple(MapClass(c) for c in (classes or mask.sidecar.classes))
    group = ReferenceGroup(group_name(marked), marked, is_truth(share, min_share) & covered)
    return Reference(grid, (group,), covered, source, describe_rule(min_share), relation.notes)


@dataclass(frozen=True)
class FrameRelation:
    """How a reference's metres reach the map's.

    Attributes:
        through_wgs84: Whether both are on earth in different frames.
        notes: What was found or assumed, for the report.
    """

    through_wgs84: bool
    notes: tuple[str, ...] = ()


def frame_relation(
    reference: MapFrame, city: MapFrame, source: str, assume_same_frame: bool = False
) -> FrameRelation:
    """Decide how a reference's metres reach the map's city frame; heights do not matter.

    Raises:
        CRSMismatchError: If only one of the two knows its place on earth.
    """
    if reference.is_georeferenced != city.is_georeferenced:
        if assume_same_frame:
            note = f"{source} is taken to be in the map's own metres, as asked for."
            return FrameRelation(False, (note,))
        lacks, knows = ("map", source) if reference.is_georeferenced else (source, "map")
        remedy = (
            "give the map one with --origin LAT,LON"
            if lacks == "map"
            else "add its origin (map_origin_latlon in a mask's JSON)"
        )
        raise CRSMismatchError(
            f"The {lacks} has no origin on earth while the {knows} has one, so their places cannot be "
            f"compared; {remedy}, or say that both use the same metres."
        )
    if not reference.is_georeferenced:
        note = f"Neither {source} nor the map has an origin on earth; both are taken to be in the same metres."
        return FrameRelation(False, (note,))
    same_crs = reference.crs_wkt == city.crs_wkt or reference.crs == city.crs
    if same_crs and np.allclose(reference.offset_m[:2], city.offset_m[:2], rtol=0, atol=1e-6):
        return FrameRelation(False)
    note = f"{source} ({reference.describe()}) was taken to the map's frame ({city.describe()}) through WGS84."
    logger.info("%s", note)
    return FrameRelation(True, (note,))


def is_truth(share: NDArrayFloat, min_share: float) -> NDArrayBool:
    """Which cells a marked share (y, x) makes truth; min_share 0 means any part at all."""
    if not 0.0 <= min_share <= 1.0:
        raise ShapeError(f"min_share must be 0..1, found {min_share}.")
    if min_share == 0.0:
        return np.asarray(share > SHARE_TOLERANCE)
    return np.asarray(share >= min_share - SHARE_TOLERANCE)


def describe_rule(min_share: float, has_lines: bool = False) -> str:
    """The rule of `is_truth` in words."""
    if min_share == 0.0:
        return "a cell is truth when any part of it is marked"
    rule = f"a cell is truth when at least {min_share:g} of it is marked"
    if has_lines:
        rule += f"; for lines, {min_share:g} of what a line so wide covers at most"
    return rule


def group_name(classes: Sequence[MapClass]) -> str:
    """Name of a union of classes."""
    if set(classes) == set(DRIVABLE_CLASSES):
        return DRIVABLE_GROUP
    return "+".join(str(MapClass(c)) for c in classes)


def no_overlap(
    source: str, bounds_m: tuple[float, float, float, float], grid: BevGrid
) -> FormatError:
    """The error for a reference of another place."""
    box = "x {0:.1f}..{2:.1f} m, y {1:.1f}..{3:.1f} m"
    return FormatError(
        f"Reference {source} ({box.format(*bounds_m)} in its own frame) does not overlap the map "
        f"({box.format(*grid.bounds_m)}); it belongs to another place, or to another origin."
    )


def _share_in_one_frame(mask: Mask, grid: BevGrid) -> tuple[NDArrayFloat, NDArrayBool]:
    """Exact marked share (y, x) and the cells wholly inside the mask.

    The integral of a picture of squares is bilinear within each pixel, so four
    interpolated look-ups of the running sum give the marked area of any rectangle.
    """
    rows, cols = grid.shape
    r, (x0, y0) = mask.sidecar.resolution_m, mask.sidecar.origin_xy_m
    u = _pixels(np.arange(grid.x_min, grid.x_max + 1), grid.resolution_m, x0, r)
    v = _pixels(np.arange(grid.y_min, grid.y_max + 1), grid.resolution_m, y0, r)
    height, width = mask.is_marked.shape
    covered = ((v[:-1] >= 0) & (v[1:] <= height))[:, None] & ((u[:-1] >= 0) & (u[1:] <= width))[
        None, :
    ]
    if not covered.any():
        return np.zeros((rows, cols)), covered
    u, v = np.clip(u, 0, width), np.clip(v, 0, height)
    # Only the part under the grid: a city's mask is far larger than a drive.
    left, low = int(u[0]), int(v[0])
    part = mask.is_marked[low : int(np.ceil(v[-1])), left : int(np.ceil(u[-1]))]
    integral = np.zeros((part.shape[0] + 1, part.shape[1] + 1))
    integral[1:, 1:] = part.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    at = _interpolated_rows(_interpolated_rows(integral, v - low).T, u - left).T
    area_px = at[1:, 1:] - at[:-1, 1:] - at[1:, :-1] + at[:-1, :-1]
    return area_px / (grid.resolution_m / r) ** 2, covered


def _pixels(edges: NDArrayInt, cell_m: float, start_m: float, pixel_m: float) -> NDArrayFloat:
    """Cell edges in pixels from the mask's corner; those that miss a pixel edge only by rounding are put on it."""
    values = (edges.astype(np.float64) * cell_m - start_m) / pixel_m
    nearest = np.round(values)
    return np.where(np.abs(values - nearest) < 1e-6, nearest, values)


def _interpolated_rows(table: NDArrayFloat, at: NDArrayFloat) -> NDArrayFloat:
    below = np.minimum(np.floor(at).astype(np.int64), len(table) - 2)
    part = (at - below)[:, None]
    return np.asarray(table[below] * (1 - part) + table[below + 1] * part)


def _share_through_wgs84(mask: Mask, grid: BevGrid) -> tuple[NDArrayFloat, NDArrayBool]:
    """Marked share (y, x), counted on points spread evenly in each cell."""
    rows, cols = grid.shape
    r, (x0, y0) = mask.sidecar.resolution_m, mask.sidecar.origin_xy_m
    k = int(np.clip(np.ceil(2 * grid.resolution_m / r), 4, 8))
    share, covered = np.zeros((rows, cols)), np.ones((rows, cols), dtype=bool)
    height, width = mask.is_marked.shape
    for i in range(k):
        for j in range(k):
            shift = (np.array([j, i]) + 0.5) / k - 0.5
            xs, ys = np.meshgrid(
                grid.x_centres_m + shift[0] * grid.resolution_m,
                grid.y_centres_m + shift[1] * grid.resolution_m,
            )
            points = np.column_stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)])
            there = mask.frame.from_wgs84(grid.frame.to_wgs84(points))[:, :2]
            if not np.isfinite(there).all():
                there = np.where(np.isfinite(there), there, -np.inf)
            uv = np.floor((there - (x0, y0)) / r)
            inside = np.asarray(((uv >= 0) & (uv < (width, height))).all(axis=1))
            uv = np.where(inside[:, None], uv, 0).astype(np.int64)
            share += (mask.is_marked[uv[:, 1], uv[:, 0]] & inside).reshape(rows, cols)
            covered &= inside.reshape(rows, cols)
    return share / k**2, covered
