"""Where a part can be gripped: a few lines of YAML a part, best grasps first.

.. code-block:: yaml

    part: bracket
    grasps:
    - {point: [0.0, 0.0, 0.002], closing: [1, 0, 0], approach: [0, 0, -1], width: 0.03}

``point`` is the middle between the fingers, ``closing`` the direction along which they close,
``approach`` the one in which the gripper comes, ``width`` the part's between them: the part's frame
and metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from dopepp.core.errors import UserError
from dopepp.core.files import check_target, write_whole
from dopepp.core.yaml import read_yaml
from dopepp.geometry.camera import Transform, make_transform
from dopepp.geometry.rotation import Vector
from dopepp.parts.part import Part

MAX_GRASPS: Final = 1000

WIDEST: Final = 0.085
"""Metres that the fingers open (2F-85)."""

CLEARANCE: Final = 0.006
"""Metres between each finger and the part as the fingers come down, where they open so far."""

_BUILT_IN: Final = Path(__file__).parent / "data"


@dataclass(frozen=True, eq=False)
class Grasp:
    """One way to grip a part; see the module."""

    point: Vector
    closing: Vector
    approach: Vector
    width: float

    @property
    def opening(self) -> float:
        """How far the fingers are apart as they come, metres."""
        return min(self.width + 2 * CLEARANCE, WIDEST)

    def T_obj_tool(self, turned: bool) -> Transform:  # noqa: N802
        """Return the tool's pose: x closes, z comes; ``turned`` by half a turn about z."""
        x = -self.closing if turned else self.closing
        return make_transform(
            np.stack([x, np.cross(self.approach, x), self.approach], axis=1), self.point
        )


def find_grasps(part: Part, path: Path | None = None) -> tuple[Grasp, ...]:
    """Return a part's grasps, out of a file or the built-in ones.

    A :class:`UserError`: the file is none of this part, or there is none.
    """
    chosen = _BUILT_IN / f"{part.name}.yaml" if path is None else path
    if path is None and not chosen.is_file():
        raise UserError(
            f"part {part.name} without a grasp", "a file of grasps for every part that is not "
            "built in", f"dopepp grasp propose {part.name}.stl --out {part.name}.yaml, then "
            f"--grasps {part.name}.yaml",
        )  # fmt: skip
    return read_grasps(chosen, part)


def read_grasps(path: Path, part: Part) -> tuple[Grasp, ...]:
    """Read a file of grasps; a :class:`UserError` where it is none, or one of another part."""
    content = read_yaml(path)
    if not isinstance(content, Mapping) or set(content) != {"part", "grasps"}:
        raise _refused(f"{path} without part: and grasps:", "both, and nothing else")
    if content["part"] != part.name:
        raise _refused(f"{path}, part: {content['part']!r:.100}", f"part: {part.name}")
    listed = content["grasps"]
    if not isinstance(listed, list) or not 0 < len(listed) <= MAX_GRASPS:
        got = f"{path}, part {part.name} without a grasp"
        raise _refused(got, f"a list of 1 to {MAX_GRASPS} grasps")
    return tuple(_parsed(one, f"{path}, grasp {k + 1}", part) for k, one in enumerate(listed))


def write_grasps(path: Path, part: Part, grasps: Sequence[Grasp]) -> None:
    """Write a file of grasps, a line each."""
    check_target(path, (".yaml", ".yml"))
    lines = [f"part: {part.name}", "grasps:"]
    for one in grasps:
        vectors = ", ".join(
            # Adding 0 makes −0 of rounding a 0.
            f"{name}: [{', '.join(f'{round(value, 5) + 0.0:g}' for value in getattr(one, name))}]"
            for name in ("point", "closing", "approach")
        )
        lines.append(f"- {{{vectors}, width: {round(one.width, 5):g}}}")
    write_whole(path, ("\n".join(lines) + "\n").encode())


def _parsed(values: object, where: str, part: Part) -> Grasp:
    names = {"point", "closing", "approach", "width"}
    if not isinstance(values, Mapping) or set(values) != names:
        raise _refused(where, "point, closing, approach and width")
    point, closing, approach = (
        _vector(values[name], f"{where}, {name}") for name in ("point", "closing", "approach")
    )
    lower, upper = part.cuboid.min(axis=0) - 0.01, part.cuboid.max(axis=0) + 0.01
    if not ((point >= lower) & (point <= upper)).all():
        raise _refused(f"{where}, point {point.tolist()}", "a point of the part, metres")
    lengths = [float(np.linalg.norm(one)) for one in (closing, approach)]
    if min(lengths) < 1e-6 or abs(closing @ approach) > 0.02 * lengths[0] * lengths[1]:
        raise _refused(where, "closing and approach at a right angle")
    width = values["width"]
    if isinstance(width, bool) or not isinstance(width, (int, float)) or not 0 < width < WIDEST:
        allowed = f"metres, more than 0 and less than {WIDEST:g}, which the fingers open"
        raise _refused(f"{where}, width {width!r:.50}", allowed)
    z = approach / lengths[1]
    x = closing - (closing @ z) * z
    return Grasp(point, x / np.linalg.norm(x), z, float(width))


def _vector(values: object, where: str) -> Float[np.ndarray, "3"]:
    try:
        found = np.array(values, np.float64)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise _refused(f"{where}: {values!r:.100}", "[x, y, z], three finite numbers")
    return found


def _refused(got: str, allowed: str) -> UserError:
    return UserError(got, allowed, "correct it, or write one with `dopepp grasp propose`")
