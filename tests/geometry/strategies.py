"""Hypothesis strategies for poses and points; figures are those of a city, not of a galaxy."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hdmap_tools.geometry.se3 import SE3

metres = st.floats(-1e4, 1e4, allow_nan=False, width=64)
unit = st.floats(-1.0, 1.0, allow_nan=False, width=64)


@st.composite
def poses(draw: st.DrawFn) -> SE3:
    quaternion = np.array([draw(unit) for _ in range(4)])
    if np.linalg.norm(quaternion) < 1e-3:
        quaternion = np.array([1.0, 0.0, 0.0, 0.0])
    return SE3.from_quaternion(*quaternion, np.array([draw(metres) for _ in range(3)]))


def points(columns: int = 3, max_size: int = 8, elements: st.SearchStrategy[float] = metres):
    shape = st.integers(0, max_size).map(lambda n: (n, columns))
    return hnp.arrays(np.float64, shape, elements=elements)
