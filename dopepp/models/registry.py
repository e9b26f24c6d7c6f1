"""Registries: allow-lists of the classes that a config or a checkpoint may name and have built.

A node is a plain dict ``{"_target_": "package.module.Class", argument: value, …}``. The dotted name
is compared with the allow-list before anything is imported, and what it resolves to is checked
again, so neither a path through another module (``dopepp.models.network.os.system``) nor a re-bound
name gets through; Hydra's own block-list of names can be walked around, an allow-list cannot.

A class of a package of your own is allowed once the package is enabled
(:mod:`dopepp.core.extensions`), or after ``register("package.module.Class")`` of the registry of
its kind (``BACKBONES.register(…)``).
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any, Final, Generic, TypeVar

from dopepp.core import extensions
from dopepp.core.errors import UserError

T = TypeVar("T")
TARGET = "_target_"

_GROUPS: Final = {kind: kind + "s" for kind in ("backbone", "attention", "head")} | {
    "loss": "losses"
}
"""Entry points of enabled packages, by kind (:mod:`dopepp.core.extensions`)."""


class Registry(Generic[T]):
    """Builds objects of one kind, and nothing else, from plain nodes.

    Messages name the kind, such as ``"backbone"``; every target inherits from ``base`` and is one
    of the dotted names of allowed classes, or of those that enabled packages add.
    """

    def __init__(self, kind: str, base: type[T], targets: Iterable[str] = ()) -> None:
        self.kind, self.base = kind, base
        self._targets, self._group = set(targets), _GROUPS.get(kind)

    @classmethod
    def of_module(cls, kind: str, base: type[T], module: ModuleType) -> Registry[T]:
        """Allow the public classes that ``module`` itself defines below ``base``."""
        own = {
            name: value
            for name, value in vars(module).items()
            if inspect.isclass(value) and value.__module__ == module.__name__ and name[0] != "_"
        }
        allowed = (name for name, one in own.items() if issubclass(one, base) and one is not base)
        return cls(kind, base, (f"{module.__name__}.{name}" for name in allowed))

    @property
    def targets(self) -> tuple[str, ...]:
        """The allowed dotted names, sorted."""
        added = extensions.found(self._group).values() if self._group else ()
        return tuple(sorted(self._targets.union(added)))

    def register(self, dotted: str) -> None:
        """Allow one more class; it is checked now, so a wrong name fails where it was written.

        A name that does not lead to a class of this registry's kind is a :class:`UserError`.
        """
        self._load(dotted)
        self._targets.add(dotted)

    def resolve(self, dotted: object) -> type[T]:
        """Return the class that an allowed name stands for.

        A :class:`UserError`: the name is not text or not in the allow-list, or it leads to
        something other than the class that the allow-list names.
        """
        if not isinstance(dotted, str) or dotted not in self.targets:
            advice = f"register your own {self.kind} in code"
            if self._group and isinstance(dotted, str) and "." in dotted:
                advice = extensions.advice(self._group, dotted)
            raise UserError(
                f"{self.kind} {TARGET} {dotted!r:.200}",
                ", ".join(self.targets) or "nothing",
                f"choose one of them, or {advice}",
            )
        return self._load(dotted)

    def build(self, node: object, **provided: Any) -> T:
        """Build a node's object.

        The node is ``{"_target_": dotted name, argument: plain value, …}``; it may not repeat what
        the caller provides. A :class:`UserError`: the target is refused, an argument is unknown,
        missing, nested or provided twice, or the class refuses a value.
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
            return target(**arguments, **provided)
        except UserError:
            raise
        except (TypeError, ValueError) as error:
            raise UserError(
                f"{node[TARGET]} with {arguments!r:.300}, which it refuses: {error}",
                f"{node[TARGET]}{inspect.signature(target)}",
                f"correct the arguments of this {self.kind}",
            ) from error

    def _load(self, dotted: str) -> type[T]:
        module_name, _, name = dotted.rpartition(".")
        try:
            value = getattr(import_module(module_name), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise UserError(
                f"{self.kind} {dotted}, which cannot be imported: {error}",
                f"the dotted name of an importable {self.base.__name__}",
                "install or import the module that defines it, or correct the name",
            ) from error
        # A package may re-export a class from a module below itself; from anywhere else, or under
        # another name, it is not the class that was allowed.
        genuine = (
            inspect.isclass(value)
            and value.__qualname__ == name
            and f"{value.__module__}.".startswith(f"{module_name}.")
        )
        if not genuine or not issubclass(value, self.base):
            raise UserError(
                f"{self.kind} {dotted}, which is {value!r:.200}",
                f"a class below {self.base.__name__} that {module_name} itself defines",
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
        parameters = inspect.signature(target).parameters
        named = {
            name: parameter
            for name, parameter in parameters.items()
            if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        }
        # Lightning's loggers hand further keywords on, so theirs cannot be listed.
        open_ended = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        free = [name for name in named if name not in provided]
        allowed = ", ".join(free) + (", …" if open_ended else "") or "no arguments"
        for key, value in arguments.items():
            unknown = key not in free and (not open_ended or key in provided)
            if not isinstance(key, str) or key.startswith("_") or unknown:
                got = f"argument {key!r:.100} of {dotted}"
                raise UserError(got, allowed, "remove or rename it")
            _check_plain(value, f"{dotted}, argument {key}")
        empty = inspect.Parameter.empty
        needed = [name for name in free if named[name].default is empty]
        if missing := ", ".join(name for name in needed if name not in arguments):
            raise UserError(f"{dotted} without {missing}", allowed, f"give {missing}")


def _check_plain(value: object, where: str) -> None:
    """Refuse everything but plain data: an argument is never itself something to build."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str) or key.startswith("_"):
                got = f"key {key!r:.100} in {where}"
                raise UserError(got, "plain values", "nested targets are not built")
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
