"""Drawing on pictures: (height, width, 3) uint8 RGB arrays, row 0 at the top.

Positions are continuous pixels: pixel (row, column) covers ``[column, column + 1)`` to
the right and ``[row, row + 1)`` down. Areas and lines are blended by the exact share of
each pixel that they cover (`unit_coverage`): OpenCV's own thick anti-aliased lines sit
up to half a pixel off, enough to hide or fake a misaligned map.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import shapely
from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry
from shapely.ops import substring

from hdmap_tools.compare.rasterize import unit_coverage
from hdmap_tools.errors import ShapeError
from hdmap_tools.formats.atomic import atomic_output
from hdmap_tools.geometry.grid import BevGrid
from hdmap_tools.types import NDArrayByte, NDArrayFloat, NDArrayInt
from hdmap_tools.view.palette import INK, PAPER, RGB

_LINES_PER_PIXEL: Final = 8
_MAX_OVERSAMPLING: Final = 8


@dataclass(frozen=True)
class Viewport:
    """The part of the city frame that a picture shows, north up and east right.

    Attributes:
        bounds_m: (x0, y0, x1, y1), city metres.
        pixels_per_metre: Scale.
    """

    bounds_m: tuple[float, float, float, float]
    pixels_per_metre: float

    def __post_init__(self) -> None:
        x0, y0, x1, y1 = self.bounds_m
        if not (np.isfinite(self.bounds_m).all() and x1 > x0 and y1 > y0):
            raise ShapeError(f"A picture needs bounds x0 < x1 and y0 < y1, found {self.bounds_m}.")
        if not (np.isfinite(self.pixels_per_metre) and self.pixels_per_metre > 0):
            raise ShapeError(f"pixels_per_metre must be positive, found {self.pixels_per_metre}.")

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels, at least 1 each."""
        x0, y0, x1, y1 = self.bounds_m
        return (
            max(round((y1 - y0) * self.pixels_per_metre), 1),
            max(round((x1 - x0) * self.pixels_per_metre), 1),
        )

    def to_pixels(self, xy_city: NDArrayFloat) -> NDArrayFloat:
        """City points (N, 2+) to continuous pixels (N, 2), right and down."""
        xy_city = np.asarray(xy_city, dtype=np.float64)
        x0, _, _, y1 = self.bounds_m
        return np.column_stack(
            [
                (xy_city[:, 0] - x0) * self.pixels_per_metre,
                (y1 - xy_city[:, 1]) * self.pixels_per_metre,
            ]
        )

    def cells(self, grid: BevGrid) -> tuple[NDArrayInt, NDArrayInt]:
        """Grid row of each picture row and grid column of each picture column; -1 is outside."""
        height, width = self.shape
        x0, _, _, y1 = self.bounds_m
        # Pixel centres: they never lie on a cell edge when a cell is a whole number of pixels.
        xs = x0 + (np.arange(width) + 0.5) / self.pixels_per_metre
        ys = y1 - (np.arange(height) + 0.5) / self.pixels_per_metre
        cols = np.floor(xs / grid.resolution_m).astype(np.int64) - grid.x_min
        rows = np.floor(ys / grid.resolution_m).astype(np.int64) - grid.y_min
        return (
            np.where((rows >= 0) & (rows < grid.shape[0]), rows, -1),
            np.where((cols >= 0) & (cols < grid.shape[1]), cols, -1),
        )


def paint_cells(
    colors: NDArrayByte, grid: BevGrid, viewport: Viewport, outside: RGB
) -> NDArrayByte:
    """A picture of cells with hard edges, (height, width, 3); cells smaller than a pixel are averaged.

    Args:
        colors: (y, x, 3) over the grid, rows going north.
        grid: The cells.
        viewport: What to show.
        outside: Colour beyond the grid.
    """
    if colors.size == 0:
        return np.full((*viewport.shape, 3), outside, dtype=np.uint8)
    cell_px = grid.resolution_m * viewport.pixels_per_metre
    factor = int(np.clip(np.ceil(1.0 / cell_px - 1e-9), 1, _MAX_OVERSAMPLING))
    fine = Viewport(viewport.bounds_m, viewport.pixels_per_metre * factor)
    rows, cols = fine.cells(grid)
    picture = colors[np.maximum(rows, 0)][:, np.maximum(cols, 0)].copy()
    picture[rows < 0, :] = outside
    picture[:, cols < 0] = outside
    if factor > 1:
        import cv2

        height, width = viewport.shape
        picture = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))
    return picture.astype(np.uint8)


def fill(picture: NDArrayByte, area: BaseGeometry, color: RGB, opacity: float = 1.0) -> None:
    """Blend an area, in continuous pixels, into a picture, in place."""
    if area.is_empty:
        return
    u0, v0, u1, v1 = area.bounds
    height, width = picture.shape[:2]
    left, right = max(int(np.floor(u0)), 0), min(int(np.ceil(u1)), width)
    top, bottom = max(int(np.floor(v0)), 0), min(int(np.ceil(v1)), height)
    if left >= right or top >= bottom:
        return
    moved = shapely.transform(area, lambda uv: uv - (left, top))
    share = (
        unit_coverage(moved, (bottom - top, right - left), _LINES_PER_PIXEL)[..., None] * opacity
    )
    part = picture[top:bottom, left:right]
    mixed = part * (1.0 - share) + np.array(color, dtype=np.float64) * share
    picture[top:bottom, left:right] = np.round(mixed).astype(np.uint8)


def draw_lines(
    picture: NDArrayByte,
    lines: Iterable[NDArrayFloat],
    color: RGB,
    width_px: float,
    *,
    dash_px: tuple[float, float] | None = None,
    casing_px: float = 0.0,
    opacity: float = 1.0,
) -> None:
    """Draw polylines (N, 2), in continuous pixels, into a picture, in place.

    Args:
        picture: Drawn on.
        lines: Each (N, 2), at least two different points.
        color: Of the lines.
        width_px: Of the lines.
        dash_px: (on, off) lengths.
        casing_px: White margin on both sides, so that lines show on any ground.
        opacity: Of the lines, 0..1.
    """
    shapes = [LineString(uv) for uv in lines if len(uv) >= 2 and np.ptp(uv, axis=0).max() > 1e-9]
    height, width = picture.shape[:2]
    # Clipped first: a line that leaves the picture far away must not cost dashes there.
    frame = shapely.box(-20, -20, width + 20, height + 20)
    shapes = [
        part
        for shape in shapes
        for part in shapely.get_parts(shapely.intersection(shape, frame))
        if part.geom_type == "LineString" and not part.is_empty
    ]
    if not shapes:
        return
    drawn = shapes if dash_px is None else [d for s in shapes for d in _dashes(s, *dash_px)]
    if casing_px > 0:
        fill(picture, _band(drawn, width_px + 2 * casing_px), PAPER, 0.75)
    fill(picture, _band(drawn, width_px), color, opacity)


def _band(lines: Sequence[LineString], width_px: float) -> BaseGeometry:
    return shapely.union_all(
        shapely.buffer(lines, width_px / 2, cap_style="flat", join_style="round", quad_segs=4)
    )


def _dashes(line: LineString, on_px: float, off_px: float) -> list[LineString]:
    starts = np.arange(0.0, line.length, on_px + off_px)
    cut = [substring(line, s, min(s + on_px, line.length)) for s in starts]
    return [d for d in cut if d.geom_type == "LineString"]


def text_width(text: str, size: float = 0.5, bold: bool = False) -> int:
    """Width of a text, pixels."""
    import cv2

    return int(cv2.getTextSize(text, _font(bold), size, 1)[0][0])


def put_text(
    picture: NDArrayByte,
    text: str,
    at: tuple[float, float],
    *,
    size: float = 0.5,
    color: RGB = INK,
    bold: bool = False,
    anchor: Literal["left", "middle", "right"] = "left",
) -> None:
    """Write one line of text with its base line at (u, v), in place.

    Characters outside ASCII become ``?``: OpenCV 4 has no others.
    """
    import cv2

    text = text.encode("ascii", "replace").decode("ascii")
    shift = {"left": 0.0, "middle": 0.5, "right": 1.0}[anchor] * text_width(text, size, bold)
    origin = (round(at[0] - shift), round(at[1]))
    cv2.putText(picture, text, origin, _font(bold), size, color, 1, cv2.LINE_AA)


def fitting_text(text: str, width_px: int, size: float = 0.5, bold: bool = False) -> str:
    """The text, cut with dots where it is wider than width_px."""
    if text_width(text, size, bold) <= width_px:
        return text
    while text and text_width(text + "...", size, bold) > width_px:
        text = text[:-1]
    return text.rstrip() + "..."


def _font(bold: bool) -> int:
    import cv2

    return int(cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX)


def draw_scale_bar(picture: NDArrayByte, pixels_per_metre: float) -> None:
    """Put a scale bar of a round length into the lower left corner, in place."""
    height, width = picture.shape[:2]
    if width < 80 or height < 40:
        return
    longest_m = 0.3 * width / pixels_per_metre
    steps = [m * 10.0**e for e in range(-2, 6) for m in (1, 2, 5)]
    length_m = max((s for s in steps if s <= longest_m), default=steps[0])
    length_px = length_m * pixels_per_metre
    k = _furniture_scale(width)
    left, base = 12.0, height - 12.0
    label = f"{length_m:g} m" if length_m < 1000 else f"{length_m / 1000:g} km"
    back = max(length_px, text_width(label, 0.45 * k)) + 16
    fill(picture, shapely.box(left - 8, base - 28 * k, left - 8 + back, base + 6), PAPER, 0.8)
    fill(picture, shapely.box(left, base - 4 * k, left + length_px, base), INK)
    white = shapely.box(left + length_px / 2, base - 4 * k + 1, left + length_px - 1, base - 1)
    fill(picture, white, PAPER)
    put_text(picture, label, (left, base - 10 * k), size=0.45 * k)


def draw_north_arrow(picture: NDArrayByte) -> None:
    """Put a north arrow into the upper right corner, in place."""
    height, width = picture.shape[:2]
    if width < 80 or height < 80:
        return
    k = _furniture_scale(width)
    u, v = width - 22.0 * k, 12.0
    fill(picture, shapely.box(u - 14 * k, v - 6, u + 14 * k, v + 42 * k), PAPER, 0.8)
    arrow = np.array([(0, 0), (8, 22), (0, 17), (-8, 22)]) * k + (u, v)
    fill(picture, shapely.Polygon(arrow), INK)
    put_text(picture, "N", (u, v + 38 * k), size=0.5 * k, bold=True, anchor="middle")


def _furniture_scale(width_px: int) -> float:
    return float(np.clip(width_px / 650, 1.0, 2.0))


def write_png(picture: NDArrayByte, path: Path, *, overwrite: bool = False) -> None:
    """Write a picture (height, width, 3) uint8 RGB as PNG: whole or not at all, same bytes each time.

    Raises:
        ShapeError: If it is not such an array.
        OutputExistsError: If the file exists and overwrite is False.
    """
    import cv2

    picture = np.asarray(picture)
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8 or not picture.size:
        raise ShapeError(
            f"A picture is (height, width, 3) uint8, found {picture.shape} {picture.dtype}."
        )
    done, data = cv2.imencode(".png", picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise ShapeError(f"A picture of {picture.shape} cannot be written as PNG.")
    with atomic_output(path, overwrite) as temporary:
        temporary.write_bytes(data.tobytes())
