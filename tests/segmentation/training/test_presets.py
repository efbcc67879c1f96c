"""The recipes say what the paper says, and their rates follow the share of the run."""

import math
from itertools import pairwise

import pytest

from hdmap_tools.errors import ConfigError
from hdmap_tools.segmentation.training.presets import PRESETS, AdamW, Sgd, find_preset


def test_paz2020_is_the_papers():
    preset = find_preset("paz2020")
    assert (preset.batch, preset.epochs, preset.pretrained) == (16, 200, True)
    assert preset.class_weight_power == 0
    rates = preset.optimizer
    assert (rates.name, rates.momentum, rates.weight_decay) == ("sgd", 0.9, 4e-5)
    for epoch in (0, 50, 199):
        assert rates.rate(epoch / 200) == pytest.approx(0.005 * (1 - epoch / 200) ** 0.9)
    cut = preset.augmentation
    assert (cut.flip, cut.scale, cut.crop_px) == (0.5, (0.5, 2.0), 640)
    assert (cut.mean, cut.std) == ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    assert (cut.brightness, cut.contrast, cut.saturation, cut.noise, cut.blur_px) == (0,) * 5


@pytest.mark.parametrize("rates", [Sgd(), AdamW()], ids=["sgd", "adamw"])
def test_rates_end_at_nothing_and_stay_there(rates):
    assert rates.rate(1.0) == pytest.approx(0, abs=1e-9)
    assert rates.rate(1.1) == pytest.approx(0, abs=1e-9)


def test_adamw_warms_up_to_its_rate_and_falls_from_there():
    rates = AdamW(learning_rate=0.01, warm_up=0.2)
    shares = [k / 100 for k in range(101)]
    values = [rates.rate(share) for share in shares]
    assert values[20] == pytest.approx(0.01) == max(values)
    assert 0 < values[0] < 0.001
    assert all(a < b for a, b in pairwise(values[:21]))
    assert all(a > b for a, b in pairwise(values[20:]))
    assert values[60] == pytest.approx(0.005)  # half of the way down is half of the rate
    assert math.isfinite(sum(values))


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"'big'; there are paz2020, small"):
        find_preset("big")
    assert set(PRESETS) == {"paz2020", "small"}
