from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

CONF = Path(__file__).parents[2] / "conf"
TINY = (
    "data=virtual",
    "data.parts=[pivconnector]",
    "virtual.preset=quickstart",
    "data.input_size=[64,64]",
    "data.samples_per_epoch=8",
    "data.batch_size=4",
    "data.num_val=2",
    "data.num_test=3",
    "data.num_workers=0",
    "model.width=0.0625",
    "trainer.max_epochs=1",
)
Composer = Callable[..., dict[str, Any]]


@pytest.fixture
def composed() -> Iterator[Composer]:
    """Compose ``conf/train.yaml`` (or another one) with overrides, as a plain dict."""

    def make(*overrides: str, config: str = "train") -> dict[str, Any]:
        node = OmegaConf.to_container(
            compose(config, list(overrides)), resolve=True, throw_on_missing=True
        )
        assert isinstance(node, dict)
        return {str(key): value for key, value in node.items()}

    with initialize_config_dir(str(CONF), version_base="1.3"):
        yield make


@pytest.fixture
def tiny(composed: Composer) -> Composer:
    """The same with a network and data that take no time."""
    return lambda *overrides: composed(*TINY, *overrides)
