import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

WriteMask = Callable[..., Path]


@pytest.fixture
def write_mask(tmp_path: Path) -> WriteMask:
    """Writes NAME.png (row 0 north) and NAME.json; keyword arguments change or drop (None) fields."""

    def write(
        picture: Any,
        resolution_m: float = 0.1,
        origin: tuple[float, float] = (0.0, 0.0),
        **fields: Any,
    ) -> Path:
        array = np.asarray(picture, dtype=np.uint8)
        path = tmp_path / "mask.png"
        path.write_bytes(cv2.imencode(".png", array)[1].tobytes())
        document = {
            "resolution_m": resolution_m,
            "origin_xy_m": list(origin),
            "size_px": [array.shape[1], array.shape[0]],
            "note": "made for a test",
            **fields,
        }
        document = {k: v for k, v in document.items() if v is not None}
        path.with_suffix(".json").write_text(json.dumps(document))
        return path

    return write
