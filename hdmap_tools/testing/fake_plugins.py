"""Distributions made on the spot, to see how plugins are found, refused and run."""

from __future__ import annotations

import importlib
import importlib.metadata
import itertools
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

_NUMBERS: Final = itertools.count()

PLUGIN_TEMPLATE: Final = """\
from typing import Annotated
import numpy as np
from pydantic import Field, field_validator
from shapely.geometry import LineString, Polygon
from hdmap_tools.plugin_api import *

class {class_name}(Vectorizer):
    name = "{name}"
    element_types = (LaneMark,)
{body}
"""

DEFAULT_BODY: Final = """\
def vectorize(self, window, upstream, options, *, rng):
    x0, y0, x1, y1 = window.grid.bounds_m
    return [LaneMark(geometry=LineString([(x0, y0, 0), (x1, y1, 0)]))]
"""


@dataclass(frozen=True)
class FakePlugins:
    """A folder of made distributions; put it on ``sys.path``, or hand out `entry_points`.

    Attributes:
        folder: Holds modules and ``*.dist-info`` folders, as site-packages does.
    """

    folder: Path

    def add(self, distribution: str, plugins: Mapping[str, str], *, version: str = "1.0") -> None:
        """Make a distribution with plugins.

        Args:
            distribution: Its name.
            plugins: By name, the body of the class (attributes and methods), or, if it
                begins with ``module:``, the whole module, which defines ``Plugin``.
            version: Its version.
        """
        lines = []
        for name, body in plugins.items():
            # A new module each time: Python would not import a known name again.
            module = f"fake_plugin_{next(_NUMBERS)}"
            if body.startswith("module:"):
                source = textwrap.dedent(body.removeprefix("module:"))
            else:
                source = PLUGIN_TEMPLATE.format(
                    class_name="Plugin",
                    name=name,
                    body=textwrap.indent(textwrap.dedent(body), "    "),
                )
            (self.folder / f"{module}.py").write_text(source, encoding="utf-8")
            lines.append(f"{name} = {module}:Plugin")
        self.register(distribution, lines, version=version)

    def register(self, distribution: str, lines: list[str], *, version: str = "1.0") -> None:
        """Write the metadata of a distribution with these lines in the entry-point group."""
        info = self.folder / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n", encoding="utf-8"
        )
        (info / "entry_points.txt").write_text(
            "\n".join(["[hdmap_tools.vectorizers]", *lines, ""]), encoding="utf-8"
        )
        importlib.invalidate_caches()

    def entry_points(self, **selection: Any) -> importlib.metadata.EntryPoints:
        """As `importlib.metadata.entry_points`, of this folder alone: whatever else is installed."""
        return importlib.metadata.EntryPoints(
            entry_point for found in self.distributions() for entry_point in found.entry_points
        ).select(**selection)

    def distributions(self, **_: Any) -> list[importlib.metadata.Distribution]:
        """As `importlib.metadata.distributions`, of this folder alone."""
        return list(importlib.metadata.Distribution.discover(path=[str(self.folder)]))
