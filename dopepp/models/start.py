"""Initial weights from a trained network, or from the package's network of random parts.

The package's weights come from networks that learned the poses of 384 random parts
(``benchmarks/learn_start.py``). A new part needs half the images from there (docs/lab/start.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import torch
from torch import Tensor

from dopepp.core.errors import UserError
from dopepp.models.checkpoint import read
from dopepp.models.network import PoseNetwork
from dopepp.models.storage import read_safetensors

FITS: Final = "backbone and head of dopepp_fast with model.width=0.5"

_FILE: Final = Path(__file__).parents[1] / "pretrained" / "start" / "dopepp_fast.safetensors"


def start_from_parts(network: PoseNetwork) -> bool:
    """Copy the package's weights of random parts to backbone and head; return whether they fit.

    The attention and the object-specific output layers keep their initial weights.
    """
    weights, _ = read_safetensors(_FILE)
    of_attention = {name for name in network.state_dict() if name.startswith("attention.")}
    return _copy(network, weights, output_tensors(network) | of_attention)


def start_from_checkpoint(network: PoseNetwork, path: Path) -> None:
    """Copy the weights of a checkpoint to a network of the same architecture.

    The output layers keep their initial weights if the number of objects or the activation differs.
    """
    checkpoint = read(path)
    weights = checkpoint.state_dict
    others: set[str] = set()
    learned = len(checkpoint.parts), checkpoint.spec["activation"]
    if learned != (network.num_objects, network.activation):
        others = output_tensors(network)
        weights = {name: value for name, value in weights.items() if name not in others}
    if not _copy(network, weights, others):
        raise UserError(
            f"init_from={path}, whose network differs from the configured one",
            "a checkpoint of the same backbone, attention, head and width",
            "set the model's options as in the run of the checkpoint, or leave out init_from",
        )


def _copy(network: PoseNetwork, weights: Mapping[str, Tensor], others: set[str]) -> bool:
    """Copy weights if names and shapes match the network without ``others``; return whether."""
    present = network.state_dict()
    if present.keys() - others != weights.keys() or any(
        present[name].shape != value.shape for name, value in weights.items()
    ):
        return False
    with torch.no_grad():
        for name, value in weights.items():
            present[name].copy_(value)
    return True


def output_tensors(network: PoseNetwork) -> set[str]:
    """Return the names of the output layers' weights, which depend on the number of objects."""
    layers = {id(layer) for layer in network.head.outputs}
    return {
        f"{name}.{tensor}"
        for name, layer in network.named_modules()
        if id(layer) in layers
        for tensor in layer.state_dict()
    }
