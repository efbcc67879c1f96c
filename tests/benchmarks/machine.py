"""What the machine itself can do, to hold figures against."""

import time

import numpy as np
from numba import njit

from hdmap_tools.fusion.block_kernels import _AT_ONCE, _project_inner

_BYTES = 256 * 2**20


@njit(nogil=True, error_model="numpy", fastmath=True)
def _total(values):
    total = np.int64(0)
    for i in range(len(values)):
        total += values[i]
    return total


def _best(function, rounds):
    best = np.inf
    for _ in range(rounds):
        begin = time.perf_counter()
        function()
        best = min(best, time.perf_counter() - begin)
    return best


def read_gb_s():
    """Bytes that one core reads from memory, GB a second."""
    values = np.ones(_BYTES // 8, dtype=np.int64)
    _total(values[:10])
    return _BYTES / _best(lambda: _total(values), 5) / 1e9


def projection_ns():
    """What one core needs to project a point that is in its fastest cache: it cannot issue faster."""
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 25_600, (2, _AT_ONCE)).astype(np.int16)
    z = rng.integers(-100, 100, _AT_ONCE).astype(np.int16)
    view = np.zeros(36, dtype=np.float32)
    view[8:20] = [0.001, 0, 0, 0, 0, 0.001, 0, 0, 0, 0, 0.001, 20.0]
    view[20:24] = 480.0, 480.0, 10.0, 10.0
    pixel, cell = np.zeros((2, _AT_ONCE), dtype=np.int32)
    depth = np.zeros(_AT_ONCE, dtype=np.float32)

    def once():
        for _ in range(50):
            _project_inner(x, y, z, view, 960, pixel, cell, depth)

    once()
    return _best(once, 20) / 50 / _AT_ONCE * 1e9
