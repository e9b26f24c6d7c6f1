"""Extension packages, discovered by their entry points and enabled by name.

A package ``mine`` declares its components in its ``pyproject.toml``::

    [project.entry-points."dopepp.backbones"]
    strided = "mine.backbones:Strided"
    [project.entry-points."dopepp.conf"]
    mine = "mine.conf"  # a folder of Hydra config files

The groups are ``backbones``, ``attentions``, ``heads``, ``losses`` (classes), ``renderers``
(modules), ``formats`` (functions that open images) and ``conf``. Config files of every installed
package are available, because they run no code. Code is imported only from enabled packages: by
``extensions=[mine]``, ``PoseEstimator.load(…, extensions=["mine"])`` or the environment variable
``DOPEPP_EXTENSIONS=mine``, which worker processes inherit.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from dopepp.core.errors import UserError

VARIABLE: Final = "DOPEPP_EXTENSIONS"
_GROUPS: Final = ("backbones", "attentions", "heads", "losses", "renderers", "formats", "conf")


def enable(packages: Iterable[str]) -> None:
    """Enable installed packages, in this process and its child processes.

    Raises:
        UserError: A package is not installed or has no entry points.
    """
    packages = list(packages)
    installed = {_package(entry) for group in _GROUPS if packages for entry in _entries(group)}
    for package in packages:
        if package not in installed:
            allowed = ", ".join(sorted(installed)) or "installed packages with dopepp entry points"
            fix = f"pip install {package}, or leave it out"
            raise UserError(f"extensions=[{package}]", allowed, fix)
    if packages:
        os.environ[VARIABLE] = ",".join(dict.fromkeys((*_enabled(), *packages)))


def components(group: str) -> dict[str, str]:
    """Return a group's components in the enabled packages: dotted Python names by short name."""
    enabled = _enabled()
    entries = _entries(group) if enabled else ()
    return {e.name: e.value.replace(":", ".") for e in entries if _package(e) in enabled}


def advice(group: str, name: str) -> str:
    """Return advice to enable, or to install, the package of a component that was not found."""
    for entry in _entries(group):
        if name in (entry.name, entry.value.replace(":", ".")):
            return f"enable its package: extensions=[{_package(entry)}]"
    package = name.partition(".")[0]
    return f"install the package {package} and enable it: extensions=[{package}]"


def config_folders() -> Iterator[tuple[str, Path]]:
    """Yield name and config folder of every installed extension package, without importing it."""
    for entry in _entries("conf"):
        package, *folders = entry.value.split(".")
        spec = find_spec(package)  # finding a top-level package does not run its code
        roots = spec.submodule_search_locations if spec is not None else None
        paths = (Path(root, *folders) for root in roots or ())
        folder = next(filter(Path.is_dir, paths), None)
        if folder is not None:
            yield _package(entry), folder


def _enabled() -> list[str]:
    return [name for name in os.environ.get(VARIABLE, "").split(",") if name]


def _entries(group: str) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=f"dopepp.{group}"))


def _package(entry: EntryPoint) -> str:
    """Return the name of the package that declares an entry point, or an empty string."""
    return "" if entry.dist is None else str(entry.dist.name)
