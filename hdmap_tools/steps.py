"""What a long command tells the outside while it goes on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from hdmap_tools.segmentation.cache import SegmentProgress


@dataclass
class Steps:
    """Progress and time of the steps of a command.

    Attributes:
        segmented: Told after each image.
        seconds: Time by step, filled in.
    """

    segmented: SegmentProgress | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the time of a block to a step."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
