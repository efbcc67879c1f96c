"""The networks have the size, the shape and the parts that they are said to have."""

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("segmentation_models_pytorch")

from hdmap_tools.errors import ConfigError  # noqa: E402
from hdmap_tools.segmentation.training.models import build_model  # noqa: E402
from hdmap_tools.segmentation.training.presets import PRESETS  # noqa: E402


@pytest.fixture(scope="module")
def paz2020():
    return build_model(PRESETS["paz2020"], 19, pretrained=False).eval()


def num_parameters(model):
    return sum(p.numel() for p in model.parameters())


def test_paz2020_has_26_million_parameters_and_100_megabytes_of_weights(paz2020):
    assert num_parameters(paz2020) == pytest.approx(26e6, rel=0.02)
    size = sum(t.numel() * t.element_size() for t in paz2020.state_dict().values())
    assert size == pytest.approx(100e6, rel=0.06)


def test_paz2020_filters_each_channel_by_itself_in_aspp_and_decoder(paz2020):
    wide = [
        (name, module)
        for name, module in paz2020.network.decoder.named_modules()
        if isinstance(module, torch.nn.Conv2d) and module.kernel_size != (1, 1)
    ]
    assert len(wide) == 5  # three atrous branches, after them, after the skip
    assert all(module.groups == module.in_channels for _, module in wide), wide
    rates = sorted(module.dilation[0] for _, module in wide)
    assert rates == [1, 1, 12, 24, 36]


def test_paz2020_sees_at_an_eighth_of_the_size(paz2020):
    with torch.inference_mode():
        features = paz2020.network.encoder(torch.zeros(1, 3, 96, 128))
    assert features[-1].shape == (1, 2048, 12, 16)


def test_small_is_small():
    model = build_model(PRESETS["small"], 11)
    size = sum(t.numel() * t.element_size() for t in model.state_dict().values())
    assert size < 4.5e6


@pytest.mark.parametrize("size", [(96, 128), (75, 109), (33, 34)])
def test_scores_have_the_size_of_the_image(paz2020, size):
    images = torch.randn(2, 3, *size)
    with torch.inference_mode():
        assert paz2020(images).shape == (2, 19, *size)
        assert build_model(PRESETS["small"], 5).eval()(images).shape == (2, 5, *size)


def test_padding_leaves_the_scores_of_a_fitting_image_alone(paz2020):
    images = torch.randn(1, 3, 64, 96)
    with torch.inference_mode():
        assert torch.equal(paz2020(images), paz2020.network(images))


def test_small_has_no_pretrained_weights():
    with pytest.raises(ConfigError, match="no pretrained"):
        build_model(PRESETS["small"], 11, pretrained=True)


@pytest.mark.parametrize("size", [(61, 74), (64, 96), (33, 47)])
def test_every_second_pixel_is_what_the_whole_says_there(size):
    network = build_model(PRESETS["small"], 5).eval()
    images = torch.randn(2, 3, *size)
    with torch.no_grad():
        whole = network(images)
        for row in (0, 1):
            for column in (0, 1):
                some = network(images, (row, column))
                assert torch.equal(some, whole[..., row::2, column::2])


def test_a_step_in_bfloat16_gives_the_same_gradient_again():
    # Dilated depthwise kernels did not: the gradient held memory that nobody had written.
    network = build_model(PRESETS["small"], 5).to(memory_format=torch.channels_last).train()
    images = torch.randn(4, 3, 192, 192).contiguous(memory_format=torch.channels_last)
    ids = torch.randint(0, 5, (4, 96, 96))

    def gradients():
        network.zero_grad(set_to_none=True)
        with torch.autocast("cpu", torch.bfloat16):
            logits = network(images, (0, 0))
        torch.nn.functional.cross_entropy(logits.float(), ids).backward()
        return {name: p.grad.clone() for name, p in network.named_parameters()}

    first = gradients()
    for _ in range(4):
        again = gradients()
        for name, gradient in first.items():
            assert torch.allclose(gradient, again[name], rtol=1e-3, atol=1e-6), name
