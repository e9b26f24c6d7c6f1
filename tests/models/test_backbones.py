import pytest
import torch
from torch import nn

from dopepp.core.errors import UserError
from dopepp.models.backbones import DSC, VGG19, Pyramid, VGG19Original
from dopepp.models.efficientnet import EfficientNetLite


def convolutions(module):
    return [layer for layer in module.modules() if isinstance(layer, nn.Conv2d)]


def num_weights(module):
    return sum(layer.weight.numel() for layer in convolutions(module))


def test_paper_counts_without_biases():
    assert num_weights(DSC()) == 1_107_776
    assert all(layer.bias is None for layer in convolutions(DSC(batch_norm=True)))
    assert num_weights(VGG19Original()) == 9_696_960


def test_dsc_is_depthwise_then_pointwise_with_relu_after_each():
    layers = [layer for layer in DSC().modules() if isinstance(layer, (nn.Conv2d, nn.ReLU))]
    assert all(isinstance(layer, nn.ReLU) for layer in layers[1::2])
    assert len(layers[::2]) == 1 + 2 * 12
    for depthwise, pointwise in zip(layers[2::4], layers[4::4], strict=True):
        assert depthwise.groups == depthwise.in_channels == depthwise.out_channels
        assert depthwise.kernel_size == (3, 3)
        assert (pointwise.kernel_size, pointwise.groups) == ((1, 1), 1)


@pytest.mark.parametrize(("width", "channels"), [(0.125, 16), (0.3, 40), (0.5, 64)])
@pytest.mark.parametrize("batch_norm", [False, True])
@pytest.mark.parametrize("backbone", [DSC, VGG19, VGG19Original])
def test_publishes_its_channels_and_stride(backbone, width, channels, batch_norm):
    check_shape(backbone(width, batch_norm), channels, 1, (64, 48))


def check_shape(backbone, channels, cell_multiple, size):
    published = (backbone.out_channels, backbone.stride, backbone.cell_multiple)
    assert published == (channels, 8, cell_multiple)
    with torch.no_grad():
        features = backbone.eval()(torch.zeros(1, 3, *size))
    assert features.shape == (1, channels, size[0] // 8, size[1] // 8)


def test_a_pyramid_has_the_weights_of_its_blocks():
    """Count the weights of blocks, and of shortcuts where the shape changes."""

    def block(before, after):
        return 9 * before * after + 9 * after * after + (before * after if before != after else 0)

    down = (block(8, 8), block(8, 16) + block(16, 16), block(16, 24), block(24, 40))
    up = (40 * 24 + block(24, 24) * 2, 24 * 16)
    backbone = Pyramid((8, 16, 24, 40), (1, 2, 1, 1), (2, 0))
    assert num_weights(backbone) == 9 * 48 * 8 + sum(down) + sum(up)
    assert all(layer.bias is None for layer in convolutions(backbone))


@pytest.mark.parametrize(
    ("width", "channels", "size"), [(0.125, 24, (64, 64)), (0.25, 48, (32, 160))]
)
@pytest.mark.parametrize("backbone", [Pyramid, EfficientNetLite])
def test_a_pyramid_publishes_its_channels_and_stride(backbone, size, width, channels):
    check_shape(backbone(width=width), channels, 4, size)


@pytest.mark.parametrize("kind", [Pyramid, EfficientNetLite])
def test_every_scale_of_a_pyramid_reaches_its_features(kind):
    torch.manual_seed(0)
    backbone = kind(width=0.125).eval()
    images = torch.randn(1, 3, 64, 64)
    with torch.no_grad():
        before = backbone(images)
        for blocks in backbone.down[1:] if kind is Pyramid else backbone.laterals:
            hook = blocks.register_forward_hook(lambda *arguments: 2 * arguments[-1])
            assert not torch.allclose(backbone(images), before)
            hook.remove()


@pytest.fixture(scope="module")
def torchvision():
    """Layers 0 to 22 of torchvision's vgg19, rebuilt, and a file's content with its keys."""
    torch.manual_seed(0)
    layers, channels = [], 3
    for wide in (64, 64, None, 128, 128, None, 256, 256, 256, 256, None, 512, 512):
        if wide is None:
            layers.append(nn.MaxPool2d(2))
        else:
            layers += [nn.Conv2d(channels, wide, 3, padding=1), nn.ReLU()]
            channels = wide
    reference = nn.Sequential(*layers[:23])
    weights = {f"features.{key}": value for key, value in reference.state_dict().items()}
    # Further weights in the file are ignored.
    return reference, weights | {"classifier.6.bias": torch.zeros(1000)}


@pytest.mark.parametrize("zipped", [True, False])
def test_loads_torchvision_weights(tmp_path, torchvision, zipped):
    reference, weights = torchvision
    torch.save(weights, tmp_path / "vgg19.pth", _use_new_zipfile_serialization=zipped)
    backbone = VGG19(weights_path=str(tmp_path / "vgg19.pth"))
    images = torch.randn(1, 3, 16, 16)
    with torch.no_grad():
        torch.testing.assert_close(backbone.layers[:-2](images), reference(images))


def test_a_file_of_something_else_is_refused(tmp_path, torchvision):
    weights = torchvision[1]
    path = tmp_path / "vgg19.pth"
    renamed = {f"module.{key}": value for key, value in weights.items()}
    other_shape = {**weights, "features.5.weight": torch.zeros(128, 64, 1, 1)}
    for content, message in (
        (renamed, r"got nothing under features\.0\.weight in .*vgg19\.pth"),
        (other_shape, r"\(128, 64, 1, 1\) under features\.5\.weight"),
        ([1, 2], "which contains a list"),
    ):
        torch.save(content, path)
        with pytest.raises(UserError, match=message):
            VGG19(weights_path=str(path))
    path.write_text("<html>404</html>")
    with pytest.raises(UserError, match="torch cannot load"):
        VGG19(weights_path=str(path))
