"""A tiny world to learn: bright, middling and dark areas, each a label of its own."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from hdmap_tools.labels.label_set import Label, LabelSet
from hdmap_tools.segmentation.training.augmentation import Augmentation
from hdmap_tools.segmentation.training.presets import PRESETS, AdamW
from hdmap_tools.segmentation.training.run_settings import RunSettings

TOY_SET = LabelSet(
    name="toy",
    labels=tuple(
        Label(id=k, name=name, color=(80 * k, 80 * k, 80 * k))
        for k, name in enumerate(("dark", "middle", "bright"))
    ),
)


@dataclass(frozen=True)
class ToyPairs:
    """Images of random boxes on dark ground, 48 x 64, labelled exactly."""

    number: int = 8
    first: int = 0
    name: str = "toy"
    label_set: LabelSet = field(default=TOY_SET)

    def __len__(self):
        return self.number

    def read(self, index):
        rng = np.random.default_rng((7, self.first + index))
        ids = np.zeros((48, 64), dtype=np.uint8)
        for label in (1, 2):
            top, left = rng.integers(0, 24), rng.integers(0, 32)
            ids[top : top + 20, left : left + 28] = label
        rgb = np.array([20, 120, 230], dtype=np.uint8)[ids][:, :, None].repeat(3, axis=2)
        ids[:2] = 255
        return rgb, ids

    def describe(self, index):
        return f"toy image {self.first + index}"


def toy_settings(**changes):
    preset = PRESETS["small"].model_copy(
        update={
            "batch": 4,
            "optimizer": AdamW(learning_rate=5e-3),
            "augmentation": Augmentation(scale=(0.8, 1.25), crop_px=48),
            "validate_epochs": 1,
            "validate_min_steps": 5,
            **changes.pop("preset", {}),
        }
    )
    given = {
        "preset": preset,
        "label_set": TOY_SET,
        "num_train": 8,
        "num_validation": 4,
        "epochs": 10,
    }
    return RunSettings(**(given | changes))


@pytest.fixture(scope="session")
def toy_pairs():
    return ToyPairs


@pytest.fixture(scope="session")
def toy_run_settings():
    return toy_settings
