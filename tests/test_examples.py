"""The scripts in examples/ run as their first lines say."""

import subprocess
import sys
from pathlib import Path

import cv2

SCRIPT = Path(__file__).resolve().parents[1] / "examples" / "draw_street_scene.py"


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, arguments)], capture_output=True, text=True
    )


def test_the_street_is_drawn(tmp_path: Path) -> None:
    done = run(tmp_path / "street.png")
    assert done.returncode == 0, done.stderr
    assert "lane_mark" in done.stdout
    picture = cv2.imread(str(tmp_path / "street.png"))
    assert picture.std() > 5


def test_without_a_file_it_says_how_it_is_used() -> None:
    done = run()
    assert done.returncode == 2
    assert done.stderr.startswith("usage: draw_street_scene.py")
    assert "Traceback" not in done.stderr
