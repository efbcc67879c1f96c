"""Large images in overlapping tiles: each at the image's own scale, and no seam between them.

Over the middle half of an overlap the scores of both tiles are blended, one fading out as
the other comes in; nearer to its edge a tile, which does not know its surroundings there, is
not used. A pixel's label is then the same as from the whole image if what the network
looks at reaches no further than a quarter of the overlap; tiles begin at whole multiples
of `ALIGN_PX`, because networks that shrink their input see a picture that is shifted by
less than their stride differently. A network that judges by the whole picture sees less of it
in a tile, and no overlap makes up for that.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hdmap_tools.errors import ConfigError
from hdmap_tools.types import NDArrayByte, NDArrayFloat32

ALIGN_PX: Final = 32
"""Total stride of the usual networks."""


@dataclass(frozen=True)
class Span:
    """One side of a tile, pixels of the image; ends are exclusive.

    Attributes:
        start: Where the tile begins.
        begin, end: From where to where it is used.
        rise, fall: Over so many pixels at its begin and end it is blended with its neighbour.
    """

    start: int
    begin: int
    end: int
    rise: int
    fall: int

    @property
    def weights(self) -> NDArrayFloat32:
        """(end - begin,) its share of the scores; with its neighbours' it adds up to one."""
        weights = np.ones(self.end - self.begin, dtype=np.float32)
        if self.rise:
            weights[: self.rise] = _ramp(self.rise)
        if self.fall:
            weights[len(weights) - self.fall :] = 1 - _ramp(self.fall)
        return weights

    @property
    def own(self) -> tuple[int, int]:
        """From where to where it weighs more than its neighbours, in the image."""
        return self.begin + self.rise // 2, self.end - (self.fall - self.fall // 2)


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

    def columns(self, width_px: int) -> list[Span]:
        """The tiles across an image of that width, from the left."""
        return _spans(width_px, self.size_px[0], self.overlap_px)

    def rows(self, height_px: int) -> list[Span]:
        """The tiles down an image of that height, from the top."""
        return _spans(height_px, self.size_px[1], self.overlap_px)

    def cut(self, rgb: NDArrayByte, column: Span, row: Span) -> NDArrayByte:
        """The tile's pixels, always of the full size: beyond the image its rim goes on."""
        width, height = self.size_px
        part = rgb[row.start : row.start + height, column.start : column.start + width]
        return padded(part, width, height)


def blended(
    strips: Iterable[NDArrayFloat32],
    rows: Sequence[Span],
    best: Callable[[NDArrayFloat32], NDArrayByte],
) -> Iterator[NDArrayByte]:
    """Labels of an image, some rows after others, from strips of tiles that overlap up and down.

    Only one strip and the part of the last that it is blended with are kept.

    Args:
        strips: (C, end - begin, width) scores of each of the rows.
        rows: Where they lie.
        best: Labels (h, w) of scores (C, h, w).
    """
    last: NDArrayFloat32 | None = None
    for strip, row in zip(strips, rows, strict=True):
        if last is not None and row.rise:
            share = row.weights[: row.rise, None]
            strip[:, : row.rise] = strip[:, : row.rise] * share + last * (1 - share)
        whole = strip.shape[1] - row.fall
        last = strip[:, whole:].copy()
        yield best(strip[:, :whole])


def padded(rgb: NDArrayByte, width_px: int, height_px: int) -> NDArrayByte:
    """An image (h, w, 3) continued to the right and below by its last column and row."""
    height, width = rgb.shape[:2]
    if (width, height) == (width_px, height_px):
        return rgb
    amounts = ((0, height_px - height), (0, width_px - width), (0, 0))
    return np.pad(rgb, amounts, mode="edge")


def _spans(length: int, size: int, overlap: int) -> list[Span]:
    if length <= size:
        return [Span(0, 0, length, 0, 0)]
    step = (size - overlap) // ALIGN_PX * ALIGN_PX
    # Rounded up: the last tile may stand out over the image by less than the alignment.
    last = -(-(length - size) // ALIGN_PX) * ALIGN_PX
    count = -(-last // step)
    starts = [i * last // count // ALIGN_PX * ALIGN_PX for i in range(count + 1)]
    # Of each overlap, which ends with the image where a tile stands out, the middle half.
    ends_in = [min(start + size, length) for start in starts]
    middles = [(end + other) // 2 for end, other in zip(ends_in, starts[1:], strict=False)]
    halves = [(end - other) // 4 for end, other in zip(ends_in, starts[1:], strict=False)]
    # Where three tiles meet (an overlap of more than half a tile), no further than to the next.
    apart = [length, *(b - a for a, b in itertools.pairwise(middles)), length]
    halves = [
        min(half, before // 2, after // 2)
        for half, (before, after) in zip(halves, itertools.pairwise(apart), strict=True)
    ]
    begins = [0, *(m - h for m, h in zip(middles, halves, strict=True))]
    ends = [*(m + h for m, h in zip(middles, halves, strict=True)), length]
    return [
        Span(start, begin, end, 2 * rise, 2 * fall)
        for start, begin, end, rise, fall in zip(
            starts, begins, ends, [0, *halves], [*halves, 0], strict=True
        )
    ]


def _ramp(length: int) -> NDArrayFloat32:
    return ((np.arange(length) + 0.5) / length).astype(np.float32)
