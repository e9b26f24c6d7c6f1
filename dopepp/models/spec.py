"""A plain dict to a network: the one description that configs and checkpoints share.

A spec holds ``backbone``, ``attention`` and ``head`` nodes (``_target_`` and arguments),
``activation`` and ``num_objects``. Channel counts are not in it: the builder hands on what each
part publishes. To make a class of another package buildable, ``BACKBONES.register(dotted name)``.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

from dopepp.core.errors import UserError
from dopepp.models import attention, backbones, heads, losses
from dopepp.models.network import PoseNetwork
from dopepp.models.registry import TARGET, Registry

BACKBONES = Registry.of_module("backbone", backbones.Backbone, backbones)  # type: ignore[type-abstract]
BACKBONES.register("dopepp.models.efficientnet.EfficientNetLite")
ATTENTIONS = Registry.of_module("attention", attention.Attention, attention)  # type: ignore[type-abstract]
HEADS = Registry.of_module("head", heads.Head, heads)
LOSSES = Registry.of_module("loss", losses.MapLoss, losses)  # type: ignore[type-abstract]

SPEC_KEYS = ("backbone", "attention", "head", "activation", "num_objects")


def build_network(spec: Mapping[str, Any]) -> PoseNetwork:
    """Build the network that a spec describes (:mod:`dopepp.models.registry` for its nodes).

    A :class:`UserError`: a key is missing or unknown, a target is not allowed, or an argument is.
    """
    _check_keys(spec)
    activation, num_objects = spec["activation"], spec["num_objects"]
    backbone = BACKBONES.build(spec["backbone"])
    channels = backbone.out_channels
    return PoseNetwork(
        backbone,
        ATTENTIONS.build(spec["attention"], channels=channels),
        HEADS.build(
            spec["head"], in_channels=channels, num_objects=num_objects, activation=activation
        ),
        activation,
        num_objects,
    )


def check_spec(spec: Mapping[str, Any]) -> None:
    """Check that a spec names nothing but allowed targets, without building any of them.

    A :class:`UserError`: a key is missing or unknown, or a target is not allowed.
    """
    _check_keys(spec)
    registries: dict[str, Registry[Any]] = {
        "backbone": BACKBONES, "attention": ATTENTIONS, "head": HEADS,
    }  # fmt: skip
    for key, registry in registries.items():
        node = spec[key]
        registry.resolve(node.get(TARGET) if isinstance(node, Mapping) else node)


def _check_keys(spec: object) -> None:
    if not isinstance(spec, Mapping) or set(spec) != set(SPEC_KEYS):
        got = sorted(map(str, spec)) if isinstance(spec, Mapping) else repr(spec)[:200]
        keys = f"exactly {', '.join(SPEC_KEYS)}"
        raise UserError(f"a model spec with {got!s:.200}", keys, "add or remove keys")


def architecture(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a deep copy of a spec without ``weights_path``.

    Pretrained weights are where training started; a checkpoint holds the trained ones, so it must
    not need, nor make its reader open, a file of somebody else's machine.
    """
    plain: dict[str, Any] = copy.deepcopy(dict(spec))
    if isinstance(plain.get("backbone"), dict):
        plain["backbone"].pop("weights_path", None)
    return plain
