"""Noise against whole numbers of any size."""

import numpy as np
import pytest

from hdmap_tools.simulate.noise_kernels import hash_unit, noise2, noise3


def _hash(x: int, y: int, z: int) -> float:
    h = (x * 374761393 + y * 668265263 + z * 2147483647) % 2**32
    h = ((h ^ (h >> 13)) * 1274126177) % 2**32
    h = ((h ^ (h >> 15)) * 1103515245) % 2**32
    return ((h ^ (h >> 16)) % 2**24) / 2**24


def test_hashes_wrap_as_32_bits_do() -> None:
    rng = np.random.default_rng(0)
    for scale in (10, 10**4, 10**6, 2**31 - 1):
        for x, y, z in rng.integers(-scale, scale, (200, 3)).tolist():
            assert hash_unit(x, y, z) == _hash(x, y, z)


def test_noise_takes_the_hashes_of_its_lattice_and_is_smooth_between() -> None:
    rng = np.random.default_rng(1)
    for x, y, z in rng.integers(-5000, 5000, (100, 3)).tolist():
        assert noise2(float(x), float(y), 17) == pytest.approx(2 * _hash(x, y, 17) - 1, abs=1e-12)
        expected = 2 * _hash(x, y, 17 + 7919 * z) - 1
        assert noise3(float(x), float(y), float(z), 17) == pytest.approx(expected, abs=1e-12)
        corners = [_hash(x + i, y + j, 17) for i in (0, 1) for j in (0, 1)]
        assert noise2(x + 0.5, y + 0.5, 17) == pytest.approx(2 * np.mean(corners) - 1, abs=1e-12)
