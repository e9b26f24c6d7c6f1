"""How many processes the trainer's options ask for."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import torch

from dopepp.errors import UserError


def num_processes(options: Mapping[str, Any]) -> int:
    """Return the number of training processes, over all machines.

    Args:
        options: The ``trainer`` config.

    Raises:
        UserError: ``devices`` or ``num_nodes`` means nothing.
    """
    # Where torchrun has started this process, the others exist already.
    world_size = os.environ.get("WORLD_SIZE", "")
    outside = int(world_size) if world_size.isdecimal() else 1
    nodes = options.get("num_nodes", 1)
    if type(nodes) is not int or nodes < 1:
        raise UserError(f"trainer.num_nodes={nodes}", "a positive integer", "correct it")
    return max(outside, nodes * _num_devices(options.get("devices", 1), options))


def _num_devices(devices: object, options: Mapping[str, Any]) -> int:
    if isinstance(devices, str) and "," in devices:
        devices = [piece for piece in devices.split(",") if piece.strip()]
    if isinstance(devices, str) and devices.lstrip("-").isdecimal():
        devices = int(devices)
    if isinstance(devices, list) and devices:
        return len(devices)
    if devices == "auto" or (devices == -1 and type(devices) is int):
        on_cpu = options.get("accelerator") == "cpu" or not torch.cuda.is_available()
        return 1 if on_cpu else torch.cuda.device_count()
    if type(devices) is int and devices > 0:
        return devices
    raise UserError(
        f"trainer.devices={devices}",
        "a positive number, a list of devices, auto or -1",
        "correct it",
    )
