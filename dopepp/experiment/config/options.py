"""Options of a config by their dotted names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence


def flat(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield the leaves of nested mappings by their dotted names; lists are leaves."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from flat(item, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def below(key: str, nodes: Sequence[str]) -> bool:
    """Tell whether an option is one of some nodes or stands below one."""
    return any(key == node or key.startswith(f"{node}.") for node in nodes)
