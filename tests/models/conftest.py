from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

PACKAGE = "dopepp.models."
SpecMaker = Callable[..., dict[str, Any]]


@pytest.fixture(scope="session")
def make_spec() -> SpecMaker:
    """A spec of named parts; ``backbone_``, ``attention_`` and ``head_`` prefixes set arguments."""

    def make(
        backbone: str = "DSC",
        attention: str = "CBAM",
        head: str = "MultiScale",
        activation: str = "exp",
        num_objects: int = 1,
        **arguments: Any,
    ) -> dict[str, Any]:
        nodes = {
            kind: {"_target_": f"{PACKAGE}{module}.{name}"}
            for kind, module, name in (
                ("backbone", "backbones", backbone),
                ("attention", "attention", attention),
                ("head", "heads", head),
            )
        }
        for key, value in arguments.items():
            kind, _, argument = key.partition("_")
            nodes[kind][argument] = value
        return {**nodes, "activation": activation, "num_objects": num_objects}

    return make


@pytest.fixture
def small_spec(make_spec: SpecMaker) -> dict[str, Any]:
    """DOPE++ at an eighth of its width: a network that is built and run in milliseconds."""
    return make_spec(backbone_width=0.125, backbone_batch_norm=True, head_width=0.125)
