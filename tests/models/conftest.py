from __future__ import annotations

from typing import Any

import pytest


@pytest.fixture(scope="session")
def make_spec():
    """Return a spec; ``backbone_``, ``attention_`` and ``head_`` prefixes set arguments."""

    def make(
        backbone: str = "DSC",
        attention: str = "CBAM",
        head: str = "MultiScale",
        activation: str = "exp",
        num_objects: int = 1,
        **arguments: Any,
    ) -> dict[str, Any]:
        module = "efficientnet" if backbone == "EfficientNetLite" else "backbones"
        nodes: dict[str, Any] = {
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
