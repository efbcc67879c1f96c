"""Large images in overlapping tiles: each at the image's own scale, and no seam between them.

Of two tiles that overlap each gives the half of the overlap on its own side, where it
knows its surroundings. A pixel's label is then the same as from the whole image if what
the network looks at reaches no further than half the overlap; tiles begin at whole
multiples of `ALIGN_PX`, because networks that shrink their input see a picture that is
shifted by less than their stride differently.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.errors import ConfigError
from hdmap_tools.types import NDArrayByte

ALIGN_PX: Final = 32
"""Total stride of the usual networks."""


@dataclass(frozen=True)
class Tile:
    """One tile of an image, pixels; ends are exclusive.

    Attributes:
        x, y: Where it begins in the image.
        keep_x, keep_y: From where to where its labels are used, in the image.
    """

    x: int
    y: int
    keep_x: tuple[int, int]
    keep_y: tuple[int, int]


@dataclass(frozen=True)
class Tiling:
    """How images are cut.

    Attributes:
        size_px: (width, height) of a tile.
        overlap_px: By how much neighbours overlap, at least.

    Raises:
        ConfigError: If the overlap leaves no step from one tile to the next.
    """

    size_px: tuple[int, int]
    overlap_px: int = 128

    def __post_init__(self) -> None:
        if self.overlap_px < 0 or min(self.size_px) - self.overlap_px < ALIGN_PX:
            raise ConfigError(
                f"Tiles of {self.size_px[0]}x{self.size_px[1]} px that overlap by {self.overlap_px} px "
                f"leave no step; the overlap must be from 0 to {ALIGN_PX} px less than the smaller "
                "side."
            )

    def tiles(self, width_px: int, height_px: int) -> Iterator[Tile]:
        """The tiles of an image, row by row; their kept parts cover each pixel once."""
        columns = list(_spans(width_px, self.size_px[0], self.overlap_px))
        for y, keep_y in _spans(height_px, self.size_px[1], self.overlap_px):
            for x, keep_x in columns:
                yield Tile(x, y, keep_x, keep_y)

    def cut(self, rgb: NDArrayByte, tile: Tile) -> NDArrayByte:
        """The tile's pixels, always of the full size: beyond the image its rim goes on."""
        width, height = self.size_px
        part = rgb[tile.y : tile.y + height, tile.x : tile.x + width]
        return padded(part, width, height)


def padded(rgb: NDArrayByte, width_px: int, height_px: int) -> NDArrayByte:
    """An image (h, w, 3) continued to the right and below by its last column and row."""
    height, width = rgb.shape[:2]
    if (width, height) == (width_px, height_px):
        return rgb
    amounts = ((0, height_px - height), (0, width_px - width), (0, 0))
    return np.pad(rgb, amounts, mode="edge")


def _spans(length: int, size: int, overlap: int) -> Iterator[tuple[int, tuple[int, int]]]:
    """Starts of tiles along one side, and what is kept of each."""
    if length <= size:
        yield 0, (0, length)
        return
    step = (size - overlap) // ALIGN_PX * ALIGN_PX
    # Rounded up: the last tile may stand out over the image by less than the alignment.
    last = -(-(length - size) // ALIGN_PX) * ALIGN_PX
    starts = [*range(0, last, step), last]
    edges = [0, *((a + size + b) // 2 for a, b in itertools.pairwise(starts)), length]
    for start, begin, end in zip(starts, edges, edges[1:], strict=False):
        yield start, (begin, end)
