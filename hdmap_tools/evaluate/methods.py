"""What is compared: the paper's four methods, and ours step by step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

from hdmap_tools.evaluate.maps import FAR_M, MapVariant

PAPER_MAP: Final = "clip"
VISIBLE_MAP: Final = "clip_visible"
OUR_MAP: Final = "clip_bands"

RANGE_EDGES_M: Final = (6.0, 10.0)
"""Bands of range in our map: a pixel at 10 m covers three times the ground that one at 6 m does."""

CONFUSION_EDGES_M: Final = (0.0, *RANGE_EDGES_M, 15.0)
"""Bands in which confusion is measured; what lies beyond the clip is not used with it."""

CLIP: Final[tuple[MapVariant, ...]] = (
    MapVariant(PAPER_MAP, occlusion_test=False),
    MapVariant(VISIBLE_MAP),
    MapVariant(OUR_MAP, range_edges_m=RANGE_EDGES_M),
)
"""The paper labels hidden points too; ours does not, and keeps near and far votes apart."""

COUNT_MODES: Final[tuple[MapVariant, ...]] = (
    MapVariant("clip_frame", occlusion_test=False, count_mode="frame"),
    MapVariant("clip_point", occlusion_test=False, count_mode="point"),
)
"""How the reference counts in truth, and how the paper's text says."""

BANDS_M: Final[tuple[tuple[float, float], ...]] = ((0.0, 10.0), (10.0, 15.0), (15.0, FAR_M))
"""Distances ahead of the ego origin by which the methods of association are compared."""

ASSOCIATIONS: Final = ("dense", "sparse", "planar")


def band_name(method: str, band_m: tuple[float, float]) -> str:
    """Name of the map of a method and a band."""
    return f"{method}_{band_m[0]:g}_{band_m[1]:g}"


BY_RANGE: Final[tuple[MapVariant, ...]] = tuple(
    MapVariant(band_name(method, band), method, ahead_m=band)
    for method in ASSOCIATIONS
    for band in BANDS_M
)


@dataclass(frozen=True)
class Method:
    """How one map is read.

    Attributes:
        name: In tables; the paper's four are named as there.
        map_name: The variant that is read.
        observation: Fields of `ObservationConfig` that differ from its defaults.
        uses_priors: Whether the class shares of the calibration drive are the prior.
        uses_learned_intensity: Whether the likelihood learned on the calibration drive is used.
        uses_temperature: Whether the temperature fitted there is used.
        uses_decision: Whether classes are decided for by the weights fitted there.
    """

    name: str
    map_name: str
    observation: dict[str, Any] = field(default_factory=dict)
    uses_priors: bool = False
    uses_learned_intensity: bool = False
    uses_temperature: bool = False
    uses_decision: bool = False


_PAPER: Final[dict[str, Any]] = {"other": False}
_OURS: Final[dict[str, Any]] = {"model": "confusion", "other": True}

PAPER_METHODS: Final[tuple[Method, ...]] = (
    Method("Vanilla", PAPER_MAP, {**_PAPER, "model": "vanilla"}),
    Method("Vanilla+I", PAPER_MAP, {**_PAPER, "model": "vanilla", "intensity": "gamma"}),
    Method("CFN", PAPER_MAP, {**_PAPER, "model": "confusion"}),
    Method("CFN+I", PAPER_MAP, {**_PAPER, "model": "confusion", "intensity": "gamma"}),
)
"""Source: Paz et al. 2020, table of results."""

_LEARNED: Final[dict[str, bool]] = {"uses_priors": True, "uses_learned_intensity": True}

OURS: Final = Method("ours", OUR_MAP, _OURS, **_LEARNED, uses_decision=True)

OUR_METHODS: Final[tuple[Method, ...]] = (
    Method("visible", VISIBLE_MAP, _OURS),
    Method("+ bands", OUR_MAP, _OURS),
    Method("+ priors", OUR_MAP, _OURS, uses_priors=True),
    Method("+ intensity", OUR_MAP, _OURS, **_LEARNED),
    OURS,
    Method("+ intensity, temperature", OUR_MAP, _OURS, **_LEARNED, uses_temperature=True),
)
"""Occlusion test and the class ``other``; then, each on top of the one before, a confusion matrix
by range, priors and intensity as learned on the calibration drive, and classes decided for
as that drive showed to be best (``ours``). The temperature is there to make probabilities
honest, not to decide by: it takes weight from the votes and leaves it to the prior."""

MODE_METHODS: Final[tuple[Method, ...]] = (
    Method("CFN, count mode frame", "clip_frame", {**_PAPER, "model": "confusion"}),
    Method("CFN, count mode point", "clip_point", {**_PAPER, "model": "confusion"}),
)
"""The paper's best with the reference's and the paper's way of counting."""
