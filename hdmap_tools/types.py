"""Array aliases used in annotations; shapes, frames and units stand in docstrings."""

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

NDArrayFloat: TypeAlias = npt.NDArray[np.float64]
NDArrayFloat32: TypeAlias = npt.NDArray[np.float32]
NDArrayInt: TypeAlias = npt.NDArray[np.int64]
NDArrayByte: TypeAlias = npt.NDArray[np.uint8]
NDArrayBool: TypeAlias = npt.NDArray[np.bool_]
NDArrayAny: TypeAlias = npt.NDArray[Any]
