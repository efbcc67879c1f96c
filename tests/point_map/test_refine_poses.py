"""Refined poses against the truth of streets driven through."""

import numpy as np

from hdmap_tools.point_map.refine_poses import refine_poses

from .street_drive import Errors, Street, aligned_errors, drive_through, true_path, with_errors


def test_a_short_drive_has_at_most_half_its_error_left() -> None:
    street, truth = Street(40), true_path(40)
    given = with_errors(truth, Errors(), seed=1)
    [refined] = refine_poses([drive_through(street, truth, given)])
    before_m, before_deg = aligned_errors(given, truth)
    after_m, after_deg = aligned_errors(refined.trajectory, truth)
    assert after_m < before_m / 2
    assert after_deg < before_deg / 2
    assert refined.is_changed
    assert np.array_equal(refined.trajectory.timestamps_ns, given.timestamps_ns)
