"""A condition that makes a test set harder or easier, level by level: shading, scale.

To add one, write a module like :mod:`dopepp.experiment.scale`: a :class:`Condition`, and a function
that measures a list of :class:`Level`. :mod:`dopepp.experiment.condition_report` writes it down.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from dopepp.errors import UserError
from dopepp.experiment.methods import FileMethod, Method
from dopepp.metrics.row import PoseRow

MAX_EXAMPLES: Final = 4
"""Images on the sheet of examples; each is shown once per level."""


@dataclass(frozen=True)
class Condition:
    """What changes from level to level, and how its levels are shown.

    Attributes:
        name: The option's name; the files are called after it.
        axis: What is changed, with the unit in which levels are shown.
        level: Name of the CSV file's column of levels.
        form: How a level is written in that unit, e.g. ``{:g} %``.
        introduction: What stands above the tables, Markdown.
        images: What the images of its levels are, of which a file has no poses.
        per_unit: By what a level is multiplied to have that unit.
        ratio: Whether levels are ratios, which a logarithmic axis spaces evenly.
    """

    name: str
    axis: str
    level: str
    form: str
    introduction: str
    images: str
    per_unit: float = 1.0
    ratio: bool = False

    @property
    def table_file(self) -> str:
        """Name of the CSV file."""
        return f"{self.name}.csv"

    def shown(self, level: float) -> float:
        """Return a level in the unit of the axis."""
        return self.per_unit * level

    def heading(self, level: float) -> str:
        """Return what stands above a level's column."""
        return self.form.format(self.shown(level))

    def check_methods(self, methods: Mapping[str, Method]) -> None:
        """Make sure that every method can be run on other images than it was run on.

        Raises:
            UserError: One of them is a file of poses.
        """
        for name, method in methods.items():
            if isinstance(method, FileMethod):
                raise UserError(
                    f"{self.name} with results of {name}, which has no poses on {self.images}",
                    "checkpoints (ckpt_path, baseline)", f"leave out {self.name} or results",
                )  # fmt: skip


@dataclass(frozen=True)
class Level:
    """What was measured at one level.

    Attributes:
        value: The level.
        rows: A row per object and their mean, by method.
        facts: Further columns of the CSV file, over all objects.
        note: What a reader must know of this level; empty for nothing.
    """

    value: float
    rows: Mapping[str, Mapping[str, PoseRow]]
    facts: Mapping[str, object] = field(default_factory=dict)
    note: str = ""
