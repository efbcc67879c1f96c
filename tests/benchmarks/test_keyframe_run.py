"""The whole `hdmap run` on the recorded keyframe, network included."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

MOST_S = 20.0


@pytest.mark.benchmark_suite
@pytest.mark.realdata
def test_the_keyframe_takes_seconds(data_root: Path, tmp_path: Path) -> None:
    pytest.importorskip("openvino", reason="the keyframe's network is an OpenVINO model")
    hdmap = Path(sys.executable).parent / "hdmap"
    seconds = []
    for number in range(3):
        start = time.perf_counter()
        subprocess.run(
            [hdmap, "run", data_root / "nuscenes", "-o", tmp_path / str(number), "--no-cache"],
            check=True,
            capture_output=True,
        )
        seconds.append(round(time.perf_counter() - start, 2))
    sys.stderr.write(f"\nhdmap run on the keyframe: {seconds} s, load {os.getloadavg()[0]:.1f}\n")
    assert min(seconds) <= MOST_S
