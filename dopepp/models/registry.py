"""Registries: allow-lists of the classes that a config or checkpoint may instantiate.

A node is a dict ``{"_target_": "package.module.Class", argument: value, …}``. The dotted name must
be in the allow-list before anything is imported, and the resolved class is checked again. This
excludes paths through other modules (``dopepp.models.network.os.system``) and re-bound names;
Hydra's own block-list can be circumvented. Arguments of backbones, attention modules, heads and
losses must have their annotated types; torch and Lightning check their classes' own arguments.

To allow your own class, enable its package (:mod:`dopepp.core.extensions`), or call ``register`` of
the registry of its kind (``BACKBONES.register("package.module.Class")``).
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Iterable, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any, Final, Generic, TypeVar

from dopepp.core import extensions
from dopepp.core.errors import UserError
from dopepp.core.validation import check

T = TypeVar("T")
TARGET = "_target_"

_GROUPS: Final = {
    "backbone": "backbones",
    "attention": "attentions",
    "head": "heads",
    "loss": "losses",
}
"""Groups of entry points by kind (:mod:`dopepp.core.extensions`)."""


class Registry(Generic[T]):
    """Builds objects of one kind from nodes (``_target_``, arguments) whose class is allowed.

    ``kind`` names the objects in messages. ``targets`` are the dotted names of the allowed classes,
    subclasses of ``base``; enabled packages may add others.
    """

    def __init__(self, kind: str, base: type[T], targets: Iterable[str] = ()) -> None:
        self.kind, self.base = kind, base
        self._targets, self._group = set(targets), _GROUPS.get(kind)

    @classmethod
    def of_module(cls, kind: str, base: type[T], module: ModuleType) -> Registry[T]:
        """Return a registry of the public subclasses of ``base`` that ``module`` defines."""
        allowed = [
            f"{module.__name__}.{value.__name__}"
            for value in vars(module).values()
            if inspect.isclass(value)
            and issubclass(value, base)
            and value is not base
            and value.__module__ == module.__name__
            and not value.__name__.startswith("_")
        ]
        return cls(kind, base, allowed)

    @property
    def targets(self) -> tuple[str, ...]:
        """The allowed dotted names, sorted."""
        added = extensions.components(self._group).values() if self._group else ()
        return tuple(sorted(self._targets.union(added)))

    def register(self, dotted: str) -> None:
        """Allow a further subclass of ``base`` by its dotted name."""
        self._load(dotted)
        self._targets.add(dotted)

    def resolve(self, dotted: object) -> type[T]:
        """Return the class with an allowed dotted name; another name raises a UserError."""
        if not isinstance(dotted, str) or dotted not in self.targets:
            advice = f"register your own {self.kind} in code"
            if self._group and isinstance(dotted, str) and "." in dotted:
                advice = extensions.advice(self._group, dotted)
            raise UserError(
                f"{self.kind} {TARGET} {dotted!r:.200}",
                ", ".join(self.targets) or "nothing",
                f"choose one of these names, or {advice}",
            )
        return self._load(dotted)

    def build(self, node: object, **provided: Any) -> T:
        """Build the object of a node (``_target_``, JSON values) and of the arguments ``provided``.

        Raises:
            UserError: The target is not allowed, an argument is unknown, missing, nested,
                provided twice or of the wrong type, or the class rejects a value.
        """
        if not isinstance(node, Mapping):
            raise UserError(
                f"{self.kind} {node!r:.200}",
                f"a mapping with {TARGET} and arguments",
                f"name one of {', '.join(self.targets)} under {TARGET}",
            )
        target = self.resolve(node.get(TARGET))
        arguments = {key: value for key, value in node.items() if key != TARGET}
        self._check_arguments(node[TARGET], target, arguments, provided)
        try:
            hints = typing.get_type_hints(target.__init__) if self._group else {}
            for name in arguments.keys() & hints.keys():
                check(f"{self.kind}.{name}", arguments[name], hints[name])
            return target(**arguments, **provided)
        except UserError:
            raise
        except (NameError, TypeError, ValueError) as error:
            raise UserError(
                f"{node[TARGET]} with {arguments!r:.300}, which failed: {error}",
                f"{node[TARGET]}{inspect.signature(target)}",
                f"pass {self.kind} arguments of this signature",
            ) from error

    def _load(self, dotted: str) -> type[T]:
        """Import a class, and check that its module defines it as a subclass of the base class."""
        module_name, _, name = dotted.rpartition(".")
        try:
            value = getattr(import_module(module_name), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise UserError(
                f"{self.kind} {dotted}, which cannot be imported: {error}",
                f"the dotted name of an importable {self.base.__name__}",
                "install or import the module that defines it, or correct the name",
            ) from error
        # A package may re-export a class of its submodules.
        is_own = (
            inspect.isclass(value)
            and value.__qualname__ == name
            and f"{value.__module__}.".startswith(f"{module_name}.")
        )
        if not is_own or not issubclass(value, self.base):
            raise UserError(
                f"{self.kind} {dotted}, which is {value!r:.200}",
                f"a subclass of {self.base.__name__} defined in {module_name}",
                "register the class under the module that defines it",
            )
        return value  # type: ignore[no-any-return]

    def _check_arguments(
        self,
        dotted: str,
        target: type[T],
        arguments: Mapping[Any, object],
        provided: Mapping[str, object],
    ) -> None:
        """Reject arguments that are unknown, missing, also in ``provided``, or not JSON values."""
        parameters = inspect.signature(target).parameters
        named = {
            name: parameter
            for name, parameter in parameters.items()
            if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        }
        # Lightning's loggers forward further keywords, which are unknown here.
        open_ended = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        free = [name for name in named if name not in provided]
        allowed = ", ".join(free) + (", …" if open_ended else "") or "no arguments"
        for key, value in arguments.items():
            unknown = key not in free and (not open_ended or key in provided)
            if not isinstance(key, str) or key.startswith("_") or unknown:
                problem = f"argument {key!r:.100} of {dotted}"
                raise UserError(problem, allowed, f"remove {key!r:.100}, or use one of these names")
            _check_plain(value, f"{dotted}, argument {key}")
        empty = inspect.Parameter.empty
        needed = [name for name in free if named[name].default is empty]
        if missing := ", ".join(name for name in needed if name not in arguments):
            raise UserError(f"{dotted} without {missing}", allowed, f"add {missing}")


def _check_plain(value: object, where: str) -> None:
    """Reject a value that is not null, a boolean, a number, text or a container of these."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str) or key.startswith("_"):
                fix = "write only plain values, without nested targets"
                raise UserError(f"key {key!r:.100} in {where}", "plain values", fix)
            _check_plain(item, where)
    elif isinstance(value, (list, tuple)):
        for item in value:
            _check_plain(item, where)
    elif value is not None and not isinstance(value, (bool, int, float, str)):
        raise UserError(
            f"a {type(value).__name__} in {where}",
            "null, true/false, numbers, text, and lists and mappings of them",
            "write a plain value",
        )
