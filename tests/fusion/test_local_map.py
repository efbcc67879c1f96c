"""The local map: exact where a motion is whole cells, of constant size, blank where it is new."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdmap_tools.association.observations import Observations
from hdmap_tools.config import ObservationConfig
from hdmap_tools.errors import ShapeError
from hdmap_tools.fusion.cell_counts import LAYERS
from hdmap_tools.fusion.local_map import LocalMap, RollRule
from hdmap_tools.fusion.observation_model import observation_model
from hdmap_tools.fusion.read_window import read_window
from hdmap_tools.geometry.se3 import SE3
from hdmap_tools.labels.label_set import MAP_CLASSES

from .builders import ADAS, counts_of, frames_of, meta, random_frame

SQUARE = (-10.0, -10.0, 10.0, 10.0)
ALWAYS = RollRule(0.0, 0.0)


def centred_frame(seed: int, extent_m: float = 9.9, number: int = 400) -> Observations:
    """Points in the middle of cells of 0.2 m, on which no rounding decides the cell."""
    rng = np.random.default_rng(seed)
    reach = int(extent_m / 0.2)
    cells = rng.integers(-reach, reach, (number, 2))
    return Observations(
        np.column_stack([(cells + 0.5) * 0.2, rng.normal(0.0, 1.0, number)]),
        rng.integers(0, len(ADAS), number).astype(np.uint8),
        rng.integers(0, 256, number).astype(np.uint8),
        rng.random(number) < 0.8,
    )


def layers_equal(a, b) -> bool:
    return all(np.array_equal(a.layers[name], b.layers[name]) for name in LAYERS)


def test_without_motion_it_holds_the_global_counts():
    frames = frames_of(3, 4)
    local = LocalMap(meta())
    for key, frame in frames:
        assert not local.update(frame, SE3.identity(), key)
    whole = counts_of(frames)
    assert layers_equal(local.counts(), whole.window(local.grid))
    assert local.counts().layers["counts"].sum() > 100
    assert local.num_rolls == 0


def test_heights_stay_those_of_the_city_frame():
    pose = SE3.from_yaw(0.3, (100.0, -40.0, 17.0))
    tilted = SE3(
        pose.rotation @ SE3.from_quaternion(1, 0.02, 0.01, 0, np.zeros(3)).rotation,
        pose.translation,
    )
    point = pose.transform_from(np.array([[5.1, 2.1, 0.0]]))
    local = LocalMap(meta(reference_height_m=10.0))
    local.update(Observations(point, np.array([1], np.uint8)), tilted, 0)
    window = local.window(model_of(local))
    assert np.nanmean(window.layer("height")) == pytest.approx(17.0, abs=1e-3)
    rows, cols = np.nonzero(window.is_known)
    at = window.grid.to_city(np.column_stack([rows, cols]))[0]
    np.testing.assert_allclose(at, (5.1, 2.1), atol=0.1)  # x ahead, y left


@given(dx=st.integers(-30, 30), dy=st.integers(-30, 30), seed=st.integers(0, 50))
@settings(max_examples=25)
def test_moving_by_whole_cells_is_exact(dx, dy, seed):
    frame = centred_frame(seed)
    local = LocalMap(meta(), SQUARE, ALWAYS)
    local.update(frame, SE3.identity(), 7)
    before = local.counts()
    moved = (dx, dy) != (0, 0)
    assert local.follow(SE3.from_yaw(0.0, (0.2 * dx, 0.2 * dy, 3.0))) == moved
    after = local.counts()
    rows, cols = local.grid.shape
    for name, old in before.layers.items():
        expected = np.zeros_like(old)
        y, x = np.mgrid[0:rows, 0:cols]
        inside = (y + dy >= 0) & (y + dy < rows) & (x + dx >= 0) & (x + dx < cols)
        expected[..., inside] = old[..., (y + dy)[inside], (x + dx)[inside]]
        np.testing.assert_array_equal(after.layers[name], expected)


@pytest.mark.parametrize("quarters", [1, 2, 3, -1])
def test_quarter_turns_are_exact(quarters):
    local = LocalMap(meta(), SQUARE, ALWAYS)
    local.update(centred_frame(1), SE3.identity(), 0)
    before = local.counts()
    assert local.follow(SE3.from_yaw(quarters * np.pi / 2))
    for name, layer in local.counts().layers.items():
        # The vehicle turns left: what was ahead lies to its right.
        expected = np.rot90(before.layers[name], quarters, axes=(-2, -1))
        np.testing.assert_array_equal(layer, expected)
    assert local.counts().layers["counts"].any()


def test_a_frame_at_a_turned_pose_lands_where_the_vehicle_saw_it():
    pose = SE3.from_yaw(np.pi / 2, (50.0, 20.0, 0.0))
    ahead = pose.transform_from(np.array([[8.1, -3.1, 0.0]]))
    local = LocalMap(meta())
    local.update(Observations(ahead, np.array([3], np.uint8)), pose, 0)
    (row, col) = np.argwhere(local.counts().layers["counts"].any(axis=(0, 1)))[0]
    assert local.grid.x_centres_m[col] == pytest.approx(8.1)
    assert local.grid.y_centres_m[row] == pytest.approx(-3.1)


def test_a_straight_drive_loses_and_smears_nothing():
    # Thirty new maps along the way, each within half a cell of the pose: what stays in view is exact.
    frame = centred_frame(2, extent_m=4.0)
    direction = SE3.from_yaw(0.7)
    far = SE3(direction.rotation, np.array([500.0, -300.0, 2.0]))
    seen = Observations(
        far.transform_from(frame.points_city + (12.0, 0.0, 0.0)), frame.labels, frame.intensity
    )
    local = LocalMap(meta())
    local.update(seen, far, 0)
    before = local.counts().layers["counts"]
    for k in range(1, 101):
        local.follow(far @ SE3(np.eye(3), np.array([0.1213 * k, 0.011 * np.sin(k), 0.0])))
    after = local.counts().layers["counts"]
    assert local.num_rolls >= 10
    assert before.sum() == after.sum() > 0
    shift = np.argwhere(before.any(axis=(0, 1))).min(axis=0) - np.argwhere(
        after.any(axis=(0, 1))
    ).min(axis=0)
    np.testing.assert_array_equal(np.roll(after, tuple(shift), axis=(-2, -1)), before)
    off = local.city_SE3_local.inverse() @ far @ SE3(np.eye(3), np.array([12.13, 0.0, 0.0]))
    assert np.hypot(*off.translation[:2]) <= 1.0 + 0.15


def test_turning_keeps_what_it_can_and_integers_stay_integers():
    frame = random_frame(np.random.default_rng(0), 3000, 12.0)
    local = LocalMap(meta(), (-20.0, -20.0, 20.0, 20.0))
    local.update(frame, SE3.identity(), 0)
    total = int(local.counts().layers["counts"].sum())
    for k in range(1, 13):
        local.follow(SE3.from_yaw(k * np.deg2rad(7.5)))
    assert local.num_rolls == 12
    turned = local.counts()
    for name, dtype in LAYERS.items():
        assert turned.layers[name].dtype == dtype
    # Nearest cells drop some and double others; on the whole none are gained or lost.
    assert int(turned.layers["counts"].sum()) == pytest.approx(total, rel=0.05)


def test_below_both_thresholds_nothing_moves():
    local = LocalMap(meta(), rule=RollRule(1.0, np.deg2rad(5)))
    local.update(centred_frame(4), SE3.identity(), 0)
    assert not local.follow(SE3.from_yaw(np.deg2rad(4.9), (0.7, 0.7, 9.0)))
    assert local.follow(SE3.from_yaw(np.deg2rad(5.1)))
    assert local.city_SE3_local.yaw_rad == pytest.approx(np.deg2rad(5.1))
    assert local.follow(SE3.from_yaw(np.deg2rad(5.1), (1.1, 0.0, 0.0)))
    # The new frame is that far along the old one, to the nearest cell, with its heading.
    assert local.city_SE3_local.yaw_rad == pytest.approx(np.deg2rad(5.1))
    assert np.hypot(*(local.city_SE3_local.translation[:2] - (1.1, 0.0))) < 0.15


def test_fresh_cells_are_unknown():
    local = LocalMap(meta(), SQUARE, ALWAYS)
    xs, ys = np.meshgrid((np.arange(-50, 50) + 0.5) * 0.2, (np.arange(-50, 50) + 0.5) * 0.2)
    everywhere = np.column_stack([xs.ravel(), ys.ravel(), 0 * xs.ravel()])
    local.update(Observations(everywhere, np.ones(len(everywhere), np.uint8)), SE3.identity(), 0)
    assert local.window(model_of(local)).is_known.all()
    local.follow(SE3.from_yaw(0.0, (3.0, 0.0, 0.0)))
    window = local.window(model_of(local))
    assert window.is_known[:, :-15].all()
    assert not window.is_known[:, -15:].any()
    assert np.isnan(window.layer("height")[:, -15:]).all()


def test_the_window_reads_like_any_map():
    local = LocalMap(meta(), SQUARE)
    frame = centred_frame(5)
    local.update(frame, SE3.identity(), 0)
    whole = counts_of([(0, frame)], meta())
    for radius in (0, 2):
        mine = local.window(model_of(local), radius)
        theirs = read_window(whole, local.grid, model_of(local), radius)
        for name in ("posterior", "observations", "height", "intensity", "entropy"):
            np.testing.assert_array_equal(
                mine.dataset[name].values, theirs.dataset[name].values
            ) if radius == 0 else np.testing.assert_allclose(
                mine.dataset[name].values[..., 3:-3, 3:-3],
                theirs.dataset[name].values[..., 3:-3, 3:-3],
                atol=1e-6,
            )


def test_its_size_does_not_grow_with_the_drive():
    local = LocalMap(meta(), SQUARE)

    def held_bytes() -> int:
        return sum(layer.nbytes for layer in local.counts().layers.values())

    start = held_bytes()
    for k in range(20):
        pose = SE3.from_yaw(0.1 * k, (40.0 * k, -25.0 * k, 0.0))
        frame = random_frame(np.random.default_rng(k), 200)
        seen = Observations(pose.transform_from(frame.points_city), frame.labels, frame.intensity)
        local.update(seen, pose, k)
    assert held_bytes() == start
    # Of jumps of 47 m nothing but the last frame is left.
    assert local.counts().layers["height_n"].sum() <= 200


def test_a_map_of_nothing_is_refused():
    with pytest.raises(ShapeError, match="extent"):
        LocalMap(meta(), (0.0, 0.0, 0.0, 5.0))
    with pytest.raises(ShapeError, match="thresholds"):
        LocalMap(meta(), rule=RollRule(-1.0, 0.0))


def model_of(local):
    return observation_model(ObservationConfig(model="vanilla"), local.meta, MAP_CLASSES, None)
