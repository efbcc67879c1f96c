"""What must work, and what must say why it does not, where torch is not installed."""

import importlib.util
import subprocess
import sys

import pytest

from hdmap_tools.errors import MissingExtraError
from hdmap_tools.segmentation.training.augmentation import Augment, Augmentation


def test_data_and_settings_need_no_torch() -> None:
    """Command lines and presets read both; torch takes seconds to import."""
    program = (
        "import sys; from hdmap_tools.segmentation.training import augmentation, pairs; "
        "augmentation.Augmentation(); sys.exit('torch' in sys.modules or 'cv2' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_augmenting_without_torch_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *rest: None if name.startswith("torch") else found(name, *rest),
    )
    with pytest.raises(MissingExtraError, match=r"torch.*pip install 'hdmap_tools\[train\]'"):
        Augment(Augmentation())
