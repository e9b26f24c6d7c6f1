"""Packages of a user's own, found by their entry points and enabled by name.

A package ``mine`` declares what it adds in its ``pyproject.toml``::

    [project.entry-points."dopepp.backbones"]
    strided = "mine.backbones:Strided"
    [project.entry-points."dopepp.conf"]
    mine = "mine.conf"  # a folder of Hydra config files

Groups are ``dopepp.`` and ``backbones``, ``attentions``, ``heads``, ``losses`` (classes),
``renderers`` (modules), ``formats`` (functions that open images) and ``conf``. The config files of
every installed package are choices, since a file does nothing by itself. Code is imported only of
packages that are enabled: by ``extensions=[mine]``, ``PoseEstimator.load(…, extensions=["mine"])``
or the environment variable ``DOPEPP_EXTENSIONS=mine``, which worker processes inherit.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError

VARIABLE: Final = "DOPEPP_EXTENSIONS"
_GROUPS: Final = ("backbones", "attentions", "heads", "losses", "renderers", "formats", "conf")


def enable(packages: Iterable[str]) -> None:
    """Allow what these installed packages add, in this process and those that it starts.

    Raises:
        UserError: A package is not installed or adds nothing.
    """
    installed = {_package(entry) for group in _GROUPS for entry in _entries(group)}
    for package in packages:
        if package not in installed:
            allowed = ", ".join(sorted(installed)) or "installed packages with dopepp entry points"
            raise UserError(f"extensions=[{package}]", allowed, f"install {package}, or leave it")
    names = dict.fromkeys((*_enabled(), *packages))
    if names:
        os.environ[VARIABLE] = ",".join(names)


def found(group: str) -> dict[str, str]:
    """Return what enabled packages add to a group: names, and what they stand for, dotted."""
    enabled = _enabled()
    if not enabled:
        return {}
    return {
        entry.name: entry.value.replace(":", ".")
        for entry in _entries(group)
        if _package(entry) in enabled
    }


def advice(group: str, name: str) -> str:
    """Return how to allow a name, or a dotted name, that no enabled package adds."""
    for entry in _entries(group):
        if name in (entry.name, entry.value.replace(":", ".")):
            return f"enable the package that adds it: extensions=[{_package(entry)}]"
    package = name.partition(".")[0]
    return f"install the package {package} and enable it: extensions=[{package}]"


def config_folders() -> Iterator[tuple[str, Path]]:
    """Yield the name and the folder of config files of every installed package; import nothing."""
    for entry in _entries("conf"):
        places = [] if entry.dist is None else [Path(str(entry.dist.locate_file("")))]
        for place in (*places, *map(Path, sys.path)):
            folder = place.joinpath(*entry.value.split("."))
            if folder.is_dir():
                yield _package(entry), folder
                break


def _enabled() -> list[str]:
    return [name for name in os.environ.get(VARIABLE, "").split(",") if name]


def _entries(group: str) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=f"dopepp.{group}"))


def _package(entry: EntryPoint) -> str:
    return "" if entry.dist is None else str(entry.dist.name)
