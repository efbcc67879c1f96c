"""How one frame votes in each cell it saw: the count modes.

Points of one frame are not independent, so a frame casts votes of fixed weight
however many points fell in the cell (except in mode ``point``, the paper's text).
"""

from __future__ import annotations

from typing import Final, Literal

CountMode = Literal["majority", "share", "frame", "point"]

SHARE_QUANTA: Final = 16
"""A frame's vote in mode ``share`` is split into so many whole parts, so that sums stay exact."""


def quanta_per_vote(mode: CountMode) -> int:
    """How many counts one frame's vote is worth."""
    return SHARE_QUANTA if mode == "share" else 1
