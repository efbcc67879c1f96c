import numpy as np
import pytest

from hdmap_tools.fusion.intensity import otsu_threshold


def test_two_groups_are_parted_between_them():
    intensity = np.array([10] * 900 + [12] * 50 + [80] * 50, dtype=np.uint8)
    assert 12 < otsu_threshold(intensity) <= 80


def test_it_agrees_with_scikit_image_on_overlapping_groups():
    from skimage.filters import threshold_otsu

    rng = np.random.default_rng(0)
    intensity = np.clip(np.r_[rng.normal(30, 10, 5000), rng.normal(120, 25, 900)], 0, 255).astype(
        np.uint8
    )
    # scikit-image gives the last value of the lower group, we the first of the upper.
    assert otsu_threshold(intensity) == threshold_otsu(intensity) + 1


@pytest.mark.parametrize("values", [[], [7, 7, 7]])
def test_nothing_to_tell_apart(values):
    assert otsu_threshold(np.array(values, dtype=np.uint8)) is None
