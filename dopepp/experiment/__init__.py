"""Experiments: the only package that knows Hydra; below it only plain values travel."""

from importlib import import_module
from types import ModuleType
from typing import Final

_FORMER_MODULES: Final = {"sweep": "runs.sweep"}
"""What users' Hydra configs call modules of hooks that have moved since, and where they are."""


def __getattr__(name: str) -> ModuleType:
    """Give a module by its former name, which Hydra looks up here before it imports."""
    if name in _FORMER_MODULES:
        return import_module(f"{__name__}.{_FORMER_MODULES[name]}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
