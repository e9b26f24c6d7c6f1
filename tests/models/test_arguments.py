"""Arguments that the components of a network refuse."""

import pytest

from dopepp.core.errors import UserError
from dopepp.models.attention import CBAM, SE
from dopepp.models.backbones import DSC, VGG19, Pyramid
from dopepp.models.efficientnet import EfficientNetLite
from dopepp.models.heads import Cascade, MultiScale, SharedTrunk
from dopepp.models.layers import find_activation
from dopepp.models.losses import SpatialCrossEntropy
from dopepp.models.network import BACKBONES, HEADS, LOSSES

MAPS = {"in_channels": 8, "num_objects": 1}
WITH_WEIGHTS = {"weights_path": "vgg19.pth"}
FULL_WIDTH = "with width=1 and batch_norm=false"


@pytest.mark.parametrize(("kind", "arguments", "message"), [
    (SE, {"reduction": 0}, "reduction=0; allowed: an integer from 1"),
    (CBAM, {"reduction": 1.5}, "reduction=1.5"),
    (CBAM, {"kernel_size": 4}, "kernel_size=4; allowed: an odd number"),
    (CBAM, {"kernel_size": 10**9}, "kernel_size=1000000000"),
    (DSC, {"width": 0}, "width=0; allowed: a number from"),
    (DSC, {"width": 100}, "width=100"),
    (VGG19, {"width": -1}, "width=-1"),
    (VGG19, {**WITH_WEIGHTS, "width": 0.5}, FULL_WIDTH),
    (VGG19, {**WITH_WEIGHTS, "batch_norm": True}, FULL_WIDTH),
    (VGG19, {"weights_path": "no.pth"}, "not a file; allowed: a torchvision state_dict"),
    (Pyramid, {"channels": (32, 96, 128)}, r"channels=.*; allowed: a list of 4 integers"),
    (Pyramid, {"channels": (32, 96, 4, 10**9)}, "a list of 4 integers from 8 to 1024"),
    (Pyramid, {"blocks": (1, 0, 2, 2)}, "blocks=.* a list of 4 integers from 1 to 16"),
    (Pyramid, {"blocks": None}, "blocks=None"),
    (Pyramid, {"top_down": (-1, 2)}, "top_down=.* a list of 2 integers from 0"),
    (Pyramid, {"width": 0}, "width=0"),
    (EfficientNetLite, {"channels": 4}, "channels=4; allowed: an integer from 8 to 1024"),
    (EfficientNetLite, {"top_down": (1, 2, 3)}, "top_down=.* a list of 2 integers"),
    (EfficientNetLite, {"width": 0}, "width=0"),
    (EfficientNetLite, {"frozen": 4}, "frozen=4; allowed: 0, 8, 16 or 32"),
    (EfficientNetLite, {"weights_path": "missing.pth"}, "missing.pth, which is not a file"),
    (Cascade, {"stages": 0}, "stages=0; allowed: an integer from 1 to 12"),
    (Cascade, {"width": float("nan")}, "width=nan"),
    (MultiScale, {"width": 4.1}, "width=4.1"),
    (MultiScale, {"maps": "all"}, "maps='all'; allowed: plain, learned or null"),
    (SharedTrunk, {"channels": 64.5}, "channels=64.5; allowed: an integer from 8 to 1024"),
    (SharedTrunk, {"blocks": 0}, "blocks=0; allowed: an integer from 1 to 16"),
    (SharedTrunk, {"num_objects": 257}, "num_objects=257"),
    (SharedTrunk, {"activation": "relu"}, "activation 'relu'; allowed: identity, exp"),
    (SpatialCrossEntropy, {"sigma": 0}, "sigma=0"),
    (SpatialCrossEntropy, {"sigma": 1, "count_weight": -1}, "count_weight=-1"),
    (find_activation, {"name": ["exp"]}, "activation .* allowed: identity, exp"),
])  # fmt: skip
def test_arguments_are_bounded(kind, arguments, message):
    provided = {SE: {"channels": 8}, CBAM: {"channels": 8}}
    provided |= dict.fromkeys((Cascade, MultiScale, SharedTrunk), MAPS)
    with pytest.raises(UserError, match=message):
        kind(**provided.get(kind, {}) | arguments)


@pytest.mark.parametrize(
    ("registry", "node", "provided", "message"),
    [
        (BACKBONES, {"_target_": "dopepp.models.backbones.DSC", "batch_norm": "yes"}, {},
         r"backbone\.batch_norm='yes'; allowed: true or false; fix: set backbone\.batch_norm"),
        (HEADS, {"_target_": "dopepp.models.heads.Cascade", "batch_norm": 1}, MAPS,
         r"head\.batch_norm=1; allowed: true or false"),
        (HEADS, {"_target_": "dopepp.models.heads.Cascade", "stages": "six"}, MAPS,
         r"head\.stages='six'; allowed: an integer"),
        (BACKBONES, {"_target_": "dopepp.models.backbones.VGG19", "weights_path": 3}, {},
         r"backbone\.weights_path=3; allowed: text"),
        (LOSSES, {"_target_": "dopepp.models.losses.SpatialCrossEntropy", "sigma": None}, {},
         r"loss\.sigma=None; allowed: a finite number"),
    ],
)  # fmt: skip
def test_a_node_s_arguments_have_the_annotated_types(registry, node, provided, message):
    with pytest.raises(UserError, match=message):
        registry.build(node, **provided)
