"""The reliability diagram: bars where the figures are."""

import numpy as np
import pytest

from hdmap_tools.compare.reliability import ReliabilityReport, reliability
from hdmap_tools.errors import OutputExistsError
from hdmap_tools.view.palette import AGREEMENT
from hdmap_tools.view.reliability_diagram import reliability_panel, reliability_picture


def curve_of(claimed: float, right: float):
    p = np.tile(np.array([[claimed], [1.0 - claimed]]), 1000)
    return reliability(p, (np.arange(1000) >= 1000 * right).astype(int))


def bar_height(picture) -> int:
    blue = (picture == np.array(AGREEMENT)).all(axis=2)
    return int(blue.any(axis=1).sum())


def test_the_bar_is_as_high_as_the_share_that_is_right():
    low, high = (bar_height(reliability_panel(curve_of(0.9, r))) for r in (0.3, 0.6))
    assert high == pytest.approx(2 * low, abs=6)
    assert high == pytest.approx(0.6 * 420, abs=6)


def test_bars_stand_where_they_claim():
    for claimed in (0.55, 0.95):
        picture = reliability_panel(curve_of(claimed, claimed))
        columns = np.nonzero((picture == np.array(AGREEMENT)).all(axis=2).any(axis=0))[0]
        assert columns.mean() == pytest.approx(58 + claimed * 420, abs=4)


def test_the_page_is_written_once(tmp_path):
    report = ReliabilityReport(
        truth="t", classes=("a", "b"), temperature=4.0, temperature_before=1.0, num_cells_fitted=9,
        before=curve_of(0.9, 0.6), after=curve_of(0.65, 0.6), rule="r",
    )  # fmt: skip
    path = tmp_path / "r.png"
    reliability_picture(report, path)
    first = path.read_bytes()
    with pytest.raises(OutputExistsError):
        reliability_picture(report, path)
    reliability_picture(report, path, overwrite=True)
    assert path.read_bytes() == first
