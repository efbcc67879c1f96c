"""Windows of a map give what the map in one piece gives."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from hdmap_tools.config import VectorizeConfig
from hdmap_tools.map_model.elements import Crosswalk, LaneMark, RoadBoundary, SidewalkArea
from hdmap_tools.testing.fake_plugins import FakePlugins
from hdmap_tools.testing.transforms import cropped
from hdmap_tools.vectorization import choose, result_of, run
from hdmap_tools.windowed.vectorize_map import joined, pieces_of_window
from hdmap_tools.windowed.windows import margin_of, windows_of

from .scene import META, TILE_M, TILES, scene

SIDEWALKS = """
element_types = (SidewalkArea,)
def vectorize(self, window, upstream, options, *, rng):
    import shapely
    rows, cols = np.nonzero(window.probability("sidewalk") > 0.5)
    r, grid = window.grid.resolution_m, window.grid
    x, y = cols + grid.x_min, rows + grid.y_min
    cells = shapely.box(x * r, y * r, (x + 1) * r, (y + 1) * r)
    area = shapely.coverage_union_all(cells).simplify(0.0)
    return [SidewalkArea(geometry=shapely.force_3d(part, 0.0)) for part in shapely.get_parts(area)
            if part.area > 4.0]
"""


def in_windows(window, config):
    """As `vectorize_map`, from a window instead of a map."""
    plugins, failures = choose(config)
    margin = margin_of(plugin.vectorizer for plugin in plugins)
    windows = windows_of(
        TILES, META, window_m=TILE_M, margin_m=margin, fill_cells=0, whole_up_to=0.0
    )
    assert len(windows) == 6
    found = []
    for one in windows:
        rows = slice(one.grid.y_min - window.grid.y_min, one.grid.y_max - window.grid.y_min)
        cols = slice(one.grid.x_min - window.grid.x_min, one.grid.x_max - window.grid.x_min)
        found.append(pieces_of_window(cropped(window, rows, cols), one, plugins, config.seed))
    runs = joined(found, windows, plugins, failures)
    return result_of(runs, window.frame, config.seed)


def in_one(window, config):
    plugins, failures = choose(config)
    return run(window, plugins, seed=config.seed, failures=failures)


BUILT_IN = VectorizeConfig(vectorizers=("crosswalk_polygon", "lane_mark_skeleton", "road_boundary"))


@pytest.fixture(scope="module", params=[0.0, 0.3], ids=["clean", "noisy"])
def both(request):
    window = scene(request.param)
    return in_one(window, BUILT_IN).vector_map, in_windows(window, BUILT_IN).vector_map


@pytest.mark.parametrize("kind", [LaneMark, RoadBoundary, Crosswalk])
def test_windows_give_what_one_piece_gives(both, kind):
    whole, windowed = (one.of_type(kind) for one in both)
    assert len(whole) == len(windowed) >= 1
    left = list(windowed)
    for element in whole:
        distances = [
            shapely.hausdorff_distance(element.geometry, other.geometry, densify=0.01)
            for other in left
        ]
        nearest = left.pop(int(np.argmin(distances)))
        assert min(distances) < 0.08
        assert nearest.geometry.length == pytest.approx(element.geometry.length, abs=0.2)
        assert nearest.geometry.is_closed == element.geometry.is_closed
        assert nearest.confidence == pytest.approx(element.confidence, abs=0.03)
        assert nearest.sigma_m == pytest.approx(element.sigma_m, rel=0.3)
        for name in ("style", "kind", "is_island"):
            assert getattr(nearest, name, None) == getattr(element, name, None)


def test_the_scene_holds_what_seams_could_spoil(both):
    whole, _ = both
    marks = whole.of_type(LaneMark)
    assert any(mark.style == "dashed" and mark.geometry.length > TILE_M for mark in marks)
    along = [mark for mark in marks if np.abs(np.array(mark.geometry.coords)[:, 1]).max() < 0.2]
    assert along
    assert along[0].geometry.length > TILE_M
    rings = [e for e in whole.of_type(RoadBoundary) if e.is_island]
    assert any(ring.geometry.bounds[0] < TILE_M < ring.geometry.bounds[2] for ring in rings)
    (crossing,) = whole.of_type(Crosswalk)
    assert crossing.geometry.bounds[0] < TILE_M < crossing.geometry.bounds[2]
    assert crossing.geometry.bounds[1] < 0.0 < crossing.geometry.bounds[3]


def test_most_elements_keep_their_ids(both):
    whole, windowed = ({element.id for element in one} for one in both)
    assert len(whole & windowed) >= 0.7 * len(whole)


@pytest.fixture
def fakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakePlugins:
    made = FakePlugins(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("importlib.metadata.entry_points", made.entry_points)
    return made


def test_an_area_with_a_hole_over_several_windows(fakes):
    fakes.add("areas", {"sidewalks": SIDEWALKS})
    window = scene()
    whole = in_one(window, VectorizeConfig()).vector_map.of_type(SidewalkArea)
    windowed = in_windows(window, VectorizeConfig()).vector_map.of_type(SidewalkArea)
    assert len(whole) == len(windowed)
    assert any(len(area.geometry.interiors) == 1 for area in whole)
    for one, other in zip(
        sorted(whole, key=lambda e: -e.geometry.area),
        sorted(windowed, key=lambda e: -e.geometry.area),
        strict=True,
    ):
        assert one.geometry.symmetric_difference(other.geometry).area < 0.05
        assert len(one.geometry.interiors) == len(other.geometry.interiors)


LINE = "LineString([(x0 + {0}, y0 + 1, 0), (x1 - {0}, y0 + 1, 0)])"


def body(expression, attributes=""):
    return (
        f"{attributes}\ndef vectorize(self, window, upstream, options, *, rng):\n"
        "    x0, y0, x1, y1 = window.grid.bounds_m\n"
        f"    return {expression}\n"
    )


def test_a_plugin_that_fails_in_one_window_loses_all_its_elements(fakes):
    mark = f"[LaneMark(geometry={LINE.format(1)})]"
    fakes.add(
        "d",
        {
            "fine": body(mark),
            "fails": body(f"{mark} if x0 < 0 else 1 / 0"),
            "needs": body(mark, "requires = ('fails',)"),
        },
    )
    result = in_windows(scene(), VectorizeConfig())
    assert {element.plugin for element in result.vector_map} == {"fine"}
    fails, needs = result.failures
    assert (fails.name, needs.name) == ("fails", "needs")
    assert "In the window x " in fails.message
    assert "division by zero" in fails.message
    assert needs.is_skipped
    assert [record["name"] for record in result.vector_map.provenance["plugins"]] == ["fine"]


def test_required_elements_are_those_of_the_same_window(fakes):
    fakes.add(
        "d",
        {
            "first": body(f"[LaneMark(geometry={LINE.format(1)})]"),
            "second": body(
                "[LaneMark(geometry=e.geometry) for e in upstream]", "requires = ('first',)"
            ),
        },
    )
    result = in_windows(scene(), VectorizeConfig())
    assert result.failures == ()
    first, second = (
        sorted(e.geometry.wkt for e in result.vector_map if e.plugin == name)
        for name in ("first", "second")
    )
    assert first == second != []


def test_ids_of_their_own_are_refused_and_the_remedy_named(fakes):
    fakes.add("d", {"named": body(f"[LaneMark(id='a', geometry={LINE.format(1)})]")})
    (failure,) = in_windows(scene(), VectorizeConfig()).failures
    assert "scope = 'map'" in failure.message
