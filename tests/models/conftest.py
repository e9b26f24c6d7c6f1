import pytest
import torch


@pytest.fixture(scope="session")
def make_spec():
    """Return a spec; ``backbone_``, ``attention_`` and ``head_`` prefixes set arguments."""

    def make(backbone="DSC", attention="CBAM", head="MultiScale", activation="exp", **arguments):
        num_objects = arguments.pop("num_objects", 1)
        module = "efficientnet" if backbone == "EfficientNetLite" else "backbones"
        nodes = {
            "backbone": {"_target_": f"dopepp.models.{module}.{backbone}"},
            "attention": {"_target_": f"dopepp.models.attention.{attention}"},
            "head": {"_target_": f"dopepp.models.heads.{head}"},
        }
        for key, value in arguments.items():
            kind, _, argument = key.partition("_")
            nodes[kind][argument] = value
        return {**nodes, "activation": activation, "num_objects": num_objects}

    return make


@pytest.fixture
def small_spec(make_spec):
    """Spec of DOPE++ at an eighth of its width, which runs in milliseconds."""
    return make_spec(backbone_width=0.125, backbone_batch_norm=True, head_width=0.125)


@pytest.fixture
def small_fast_spec(make_spec):
    """Spec of the fast DOPE++ at a sixteenth of its width, with lists as in YAML and JSON."""
    shape = {"backbone_channels": [64, 192, 256, 256], "backbone_blocks": [1, 2, 1, 2]}
    sizes = {"backbone_width": 0.0625, "attention_reduction": 2, "head_width": 0.0625}
    return make_spec("Pyramid", "SE", "SharedTrunk", **shape, **sizes)


def weights_of(network):
    """Return a copy of a network's weights and buffers."""
    return {name: value.clone() for name, value in network.state_dict().items()}


def assert_weights(network, expected):
    """Compare all weights and buffers exactly."""
    torch.testing.assert_close(dict(network.state_dict()), dict(expected), rtol=0, atol=0)
