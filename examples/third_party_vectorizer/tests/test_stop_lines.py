"""What this vectorizer is about, on scenes whose truth is known."""

import numpy as np
import pytest
from hdmap_stop_line_example import StopLineExample
from shapely import affinity
from shapely.geometry import LineString, box

from hdmap_tools.plugin_api import BevGrid, MapWindow, StopLine, VectorMap
from hdmap_tools.testing.scenes import street_scene, window_from_shapes


def stop_lines_in(window: MapWindow, **options: float) -> list[StopLine]:
    vectorizer = StopLineExample()
    return vectorizer.vectorize(
        window,
        VectorMap(window.frame),
        vectorizer.Options(**options),
        rng=np.random.default_rng(0),
    )


def test_finds_the_stop_line_of_the_street_and_no_lane_mark() -> None:
    (found,) = stop_lines_in(street_scene(stop_line=True))
    truth = LineString([(33.25, 10.2), (33.25, 13.4)])
    assert truth.hausdorff_distance(found.geometry) < 0.1
    assert found.width_m == pytest.approx(0.5, abs=0.1)


def test_a_street_without_one_gives_none() -> None:
    assert stop_lines_in(street_scene()) == []


@pytest.mark.parametrize("angle_deg", [0, 17, 45, 90, 133])
def test_any_direction(angle_deg: float) -> None:
    truth = affinity.rotate(LineString([(10.0, 8.4), (10.0, 11.6)]), angle_deg)
    paint = truth.buffer(0.25, cap_style="flat")
    grid = BevGrid.from_bounds((0, 0, 20, 20), 0.1)
    window = window_from_shapes({"road": box(0, 0, 20, 20), "lane_mark": paint}, grid)
    (found,) = stop_lines_in(window)
    assert truth.hausdorff_distance(found.geometry) < 0.1


def test_options_set_what_counts() -> None:
    assert stop_lines_in(street_scene(stop_line=True), min_length_m=4.0) == []
