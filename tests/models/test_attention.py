import numpy as np
import pytest
import torch
from scipy.signal import correlate2d

from dopepp.models.attention import CBAM, SE


def sigmoid(values):
    return 1 / (1 + np.exp(-values))


def weights_of(module):
    return {name: value.detach().numpy() for name, value in module.named_parameters()}


@pytest.mark.parametrize("kernel_size", [3, 7])
def test_cbam_is_equations_5_and_6(kernel_size):
    torch.manual_seed(0)
    module = CBAM(8, reduction=2, kernel_size=kernel_size).double()
    features = torch.randn(2, 8, 5, 6, dtype=torch.float64)
    weights = weights_of(module)

    def mlp(vector):
        return weights["mlp.2.weight"] @ np.maximum(weights["mlp.0.weight"] @ vector, 0)

    for image, result in zip(features.numpy(), module(features).detach().numpy(), strict=True):
        channel = sigmoid(mlp(image.mean((1, 2))) + mlp(image.max((1, 2))))
        scaled = image * channel[:, None, None]
        planes = zip((scaled.mean(0), scaled.max(0)), weights["spatial.weight"][0], strict=True)
        spatial = sum(correlate2d(plane, kernel, mode="same") for plane, kernel in planes)
        np.testing.assert_allclose(result, scaled * sigmoid(spatial), rtol=1e-10)


def test_cbam_defaults_to_the_paper():
    module = CBAM(128)
    assert (module.spatial.kernel_size, module.mlp[0].out_features) == ((3, 3), 128 // 16)


def test_se_weighs_channels_by_their_mean():
    torch.manual_seed(0)
    module = SE(8, reduction=4).double()
    features = torch.randn(2, 8, 3, 4, dtype=torch.float64)
    weights = weights_of(module)
    hidden = np.maximum(features.numpy().mean((2, 3)) @ weights["mlp.0.weight"].T, 0)
    expected = features.numpy() * sigmoid(hidden @ weights["mlp.2.weight"].T)[:, :, None, None]
    np.testing.assert_allclose(module(features).detach().numpy(), expected, rtol=1e-10)
