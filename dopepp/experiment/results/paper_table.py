"""The paper's tables: a sweep's runs in the paper's layout, beside what the paper printed.

A config names its table under ``table`` (see ``conf/experiment/``).

To add a kind of table, write a function of layout, methods and folder that returns rows, and what
must be said of them, and give it a line in :data:`KINDS`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import t

from dopepp.core.errors import UserError
from dopepp.core.files import write_csv, write_png, write_whole
from dopepp.core.validation import STRICT, parse
from dopepp.core.yaml import read_yaml
from dopepp.drawing.curves import figure_image, rates_figure
from dopepp.experiment.results import display, tables
from dopepp.experiment.results.conditions import SHADING
from dopepp.experiment.results.cost import (
    COST_FILE,
    FRAMES_FILE,
    NOTE,
    read_frames,
    save_frame_rates,
)
from dopepp.experiment.results.differences import (
    REFINED_NOTE,
    figures,
    noise,
    row_figures,
    summary,
)
from dopepp.experiment.results.entries import Entry
from dopepp.experiment.results.folder import read_json
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS

TEXT_FILE: Final = "table.md"
TABLE_FILE: Final = "table.csv"

Printed = Mapping[str, Mapping[str, Mapping[str, int | float]]]
"""Figures by label, object and measure."""

_LABELS: Final = ("method", "object", "measure")
"""Headings of what is no number."""

_METHOD, _OBJECT, _MEASURE = _LABELS
_STRICT: Final = "add_01d"
_NETWORK: Final = "network"
"""What stands for the object, where there is none."""
_PAPER: Final = "the paper"

_PASS_FIELDS: Final = {rate.threshold: rate.field for rate in (tables.ADD_5CM, tables.ADD_10CM)}
_MEASURED: Final = ("poses", "shading")
"""Kinds that rest on trained networks."""
_UNTRAINED: Final = "dopepp.models.backbones.VGG19"


@dataclass(frozen=True)
class PaperTable:
    """How a sweep's table is laid out.

    Attributes:
        title: With the paper's number.
        kind: A key of :data:`KINDS`.
        threshold: Of the paper's pass rate: 0.05 m for parts, 0.1 m for YCB-Video.
        labels: Override to what the paper calls it; a run that has several gets all of them.
        paper: What the paper prints: by label, object and measure, which is a field of ``PoseRow``
            (``pass`` for the paper's pass rate) or a heading; percent, or as the heading says.
        recomputed: Other methods, measured with this project's functions; likewise.
        notes: What must be said below the table.
    """

    __pydantic_config__ = STRICT
    title: str
    kind: str = "poses"
    threshold: float = 0.05
    labels: Mapping[str, str] = field(default_factory=dict)
    paper: Printed = field(default_factory=dict)
    recomputed: Printed = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> PaperTable:
        """Read the config's ``table``; a :class:`UserError` if a field or a value is unknown."""
        table = parse(cls, config, "table")
        if table.kind not in KINDS:
            raise UserError(f"table.kind={table.kind!r}", ", ".join(KINDS), "choose one of them")
        if table.threshold not in _PASS_FIELDS:
            allowed = ", ".join(f"{one:g}" for one in _PASS_FIELDS)
            raise UserError(f"table.threshold={table.threshold}", f"{allowed}, metres", "change it")
        return table

    @classmethod
    def read(cls, path: Path) -> PaperTable:
        """Read the ``table`` of an experiment's file, ``conf/experiment/NAME.yaml``.

        A :class:`UserError`: the file cannot be read, or its table is missing or wrong.
        """
        config = read_yaml(path)
        table = config.get("table") if isinstance(config, dict) else None
        if not isinstance(table, dict):
            raise UserError(
                f"{path}, which lays out no table", "an experiment with `table:`",
                "pass conf/experiment/table….yaml",
            )  # fmt: skip
        return cls.of(table)

    @property
    def pass_field(self) -> str:
        """Field of a row that holds the paper's pass rate."""
        return _PASS_FIELDS[self.threshold]

    def methods(self, entries: Sequence[Entry]) -> dict[str, Entry]:
        """Return the methods by what the paper calls them, or by their own name.

        The own name serves where the paper's would stand for several. Refined poses are the paper's
        method and what refined them.
        """
        called = [self._label(entry) or entry.name for entry in entries]
        count = Counter(called)
        return {
            label if count[label] == 1 else entry.name: entry
            for label, entry in zip(called, entries, strict=True)
        }

    def _label(self, entry: Entry) -> str:
        used = entry.runs[0].overrides if entry.runs else []
        label = " ".join(self.labels[key] for key in self.labels if key in used)
        return f"{label} + {entry.refine}" if label and entry.refine else label


def write_paper_table(table: PaperTable, entries: Sequence[Entry], folder: Path) -> None:
    """Print and write ``table.md`` and ``table.csv``, and the figure of a kind that has one."""
    title = ", ".join([table.title, *(_recipe(entries) if table.kind in _MEASURED else [])])
    if table.kind not in _MEASURED:  # what a network costs is no matter of its poses
        entries = [entry for entry in entries if not entry.refine]
    methods = table.methods(entries)
    rows, doubts = KINDS[table.kind](table, methods, folder)
    labels = sum(name in _LABELS for name in rows[0])
    display.show_table(title, rows, num_labels=labels)
    write_csv(folder / TABLE_FILE, rows)
    notes = [f"- {note}" for note in (*_notes(table, entries), *doubts)]
    text = "\n".join([f"# {title}", "", tables.markdown_text(rows), *notes])
    write_whole(folder / TEXT_FILE, f"{text}\n".encode())


def _recipe(entries: Sequence[Entry]) -> list[str]:
    """Say with which loss and schedule the networks were trained, ours or the paper's."""
    words = {str(run.config.get("recipe")) for entry in entries for run in entry.runs}
    known = sorted(words & {"ours", "paper"})
    return [f"recipe={' and '.join(known)}"] if known else []


def _notes(table: PaperTable, entries: Sequence[Entry]) -> list[str]:
    notes = [*table.notes, *([NOTE] if table.kind == "time" else [])]
    if table.kind in _MEASURED:
        notes.append(f"The paper's pass rate is ADD < {table.threshold:g} m.")
        if any(entry.refine for entry in entries):
            notes.append(REFINED_NOTE)
        if any(_starts_untrained(run.config) for entry in entries for run in entry.runs):
            said = "DOPE's VGG19 started untrained, as nothing is downloaded"
            option = "model.backbone.weights_path=FILE"
            notes.append(f"{said}; {option} starts it from a file of torchvision's.")
    if not table.paper:
        notes.append("The paper prints no such table.")
    return notes


def _starts_untrained(config: Mapping[str, Any]) -> bool:
    """Tell whether a run's network has a VGG19 that nobody has trained before."""
    model = config.get("model")
    backbone = model.get("backbone") if isinstance(model, dict) else None
    if not isinstance(backbone, dict) or config.get("init_from") is not None:
        return False
    return backbone.get("_target_") == _UNTRAINED and backbone.get("weights_path") is None


Laid = tuple[list[tables.Row], list[str]]
"""Rows, and the doubts about them."""


def pose_rows(layout: PaperTable, methods: Mapping[str, Entry], folder: Path) -> Laid:
    """Return, object by object, a row per method: the paper's measures, then stricter ones.

    The first method with a result is what Δ is against, of refined poses the first refined. The
    reference rows stand at the end.
    """
    table = figures([replace(entry, name=label) for label, entry in methods.items()])
    measured = [entry for entry in methods.values() if entry.reports]
    objects = list(dict.fromkeys(name for entry in measured for name in entry.objects))
    if not objects:  # nothing was measured: the paper's figures and why there are no others
        objects = list(dict.fromkeys(name for one in layout.paper.values() for name in one))
    rows = []
    for name in objects:
        for label in dict.fromkeys([*methods, *layout.recomputed, *layout.paper]):
            known = layout.paper.get(label, {})
            own = layout.recomputed.get(label, {})
            # The paper's mean is over its own objects.
            is_other_mean = name == MEAN and set(known) != set(objects)
            printed = {} if is_other_mean else known.get(name, {})
            entry = methods.get(label)
            if entry is not None and name in entry.objects:
                found = tables.select(table, method=label, object=name)
                rows.append(_pose_row(layout, label, name, _texts(found), printed))
            elif entry is not None:
                reason = f"{label}: {entry.failure or 'not measured on it'}"
                rows.append(_pose_row(layout, reason, name, {}, printed))
            elif name in known or name in own:
                texts = {_field(layout, k): _number(v) for k, v in own.get(name, {}).items()}
                rows.append(_pose_row(layout, label, name, texts, printed))
    for name in objects if measured else ():
        for reference, by_object in measured[0].reports[0].references.items():
            if name in by_object:
                texts = _texts(row_figures(reference, by_object[name]))
                rows.append(_pose_row(layout, reference, name, texts, {}))
    return rows, noise(table)


def _texts(table: Iterable[tables.Figure]) -> tables.Row:
    return {one.measure: summary(one) for one in table}


def _field(layout: PaperTable, key: str) -> str:
    """Return the field of ``PoseRow`` that a config's figure is of."""
    return layout.pass_field if key == "pass" else key


def _pose_row(
    layout: PaperTable, method: str, name: str, texts: tables.Row, printed: Mapping[str, float]
) -> tables.Row:
    """Return a row: the text of every measure, what the paper prints of it, and Δ."""
    row = {_METHOD: method, _OBJECT: name}
    for key in ("pass", "auc_10cm", _STRICT, "median_rotation_deg"):
        measure = _field(layout, key)
        row[tables.heading(measure)] = texts.get(measure, "")
        if key in ("pass", "auc_10cm"):
            row[f"{_PAPER}: {tables.heading(measure)}"] = _number(printed.get(key))
        if key in ("pass", _STRICT):
            row[f"{tables.DELTA}{tables.heading(measure)}"] = texts.get(
                f"{tables.DELTA}{measure}", ""
            )
    return row


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:,}"


def shading_rows(layout: PaperTable, methods: Mapping[str, Entry], folder: Path) -> Laid:
    """Return pass rates at every share, the paper's and Δ beside them; draw them for all methods.

    Rates are means over seeds. Δ is to the first method at the same share, of refined poses to the
    first refined, whose own Δ is to the first of all; its interval is Student's t of the
    differences of equal seeds.
    """
    measured = {label: _shading(label, entry) for label, entry in methods.items()}
    table = [one for own in measured.values() for one in own]
    rows: list[tables.Row] = [
        {_METHOD: _failed(label, methods[label]), _OBJECT: "", _MEASURE: ""}
        for label, own in measured.items()
        if not own
    ]
    panels = {}
    for name in dict.fromkeys(one.object for one in table):
        for measure in (layout.pass_field, _STRICT):
            firsts: dict[str, dict[float, list[tables.Figure]]] = {}  # by how poses are refined
            pooled: list[tables.Figure] = []
            head = {_OBJECT: name, _MEASURE: tables.heading(measure)}
            for label in dict.fromkeys(one.method for one in tables.select(table, object=name)):
                own = tables.select(table, method=label, object=name, measure=measure)
                rates = {one.condition: tables.select(own, condition=one.condition) for one in own}
                levels = {share: SHADING.heading(share) for share in rates}
                means = {levels[share]: _mean(rates[share]) for share in rates}
                rows.append({_METHOD: label, **head, **means})
                refine = methods[label].refine
                if firsts:
                    baseline = firsts.get(refine) or next(iter(firsts.values()))
                    changes = {levels[s]: _change(rates[s], baseline.get(s, [])) for s in rates}
                    rows.append({_METHOD: f"{tables.DELTA}{label}", **head, **changes})
                firsts.setdefault(refine, rates)
                printed = layout.paper.get(label, {}).get(name, {})
                if printed and measure == layout.pass_field:
                    texts = {share: _number(value) for share, value in printed.items()}
                    rows.append({_METHOD: f"{label}, {_PAPER}", **head, **texts})
                pooled += map(_pooled, rates.values())
            panels[f"{name}: {tables.heading(measure)}"] = tables.rate_curves(
                pooled, SHADING.per_unit
            )
    if panels:
        figure = rates_figure(panels, SHADING.axis, 2)
        write_png(folder / "table_shading.png", figure_image(figure))
    return rows, []


def _shading(label: str, entry: Entry) -> list[tables.Figure]:
    """Return what a method's runs have measured; of one network a part, the mean, too.

    A run's file may hold other methods, and its own twice, as the network's and refined.
    """
    found: dict[object, tables.Figure] = {}
    for run in entry.runs:
        report = run.report.refined if run.report and entry.refine else run.report
        for row in tables.read_csv(run.folder / SHADING.table_file):
            if report is None or row["method"] != report.name:
                continue
            for measure in (column.field for column in COLUMNS if row.get(column.field)):
                key = row["object"], measure, float(row["share"]), run.seed
                found[key] = tables.Figure(
                    label, row["object"], measure, float(row[measure]), float(row["share"]),
                    (run.seed,), int(row["num_instances"]),
                )  # fmt: skip
    table = list(found.values())
    objects = {one.object for one in table}
    if len(objects) < 2 or MEAN in objects:
        return table
    alike: dict[object, list[tables.Figure]] = {}
    for one in table:
        alike.setdefault((one.measure, one.condition, one.seeds), []).append(one)
    # The mean is over what all parts have.
    whole = [own for own in alike.values() if len(own) == len(objects)]
    return table + [replace(_pooled(own), object=MEAN) for own in whole]


def _pooled(rates: Sequence[tables.Figure]) -> tables.Figure:
    """Return the mean of rates, as one over all their instances."""
    return replace(
        rates[0],
        value=float(np.mean([one.value for one in rates])),
        num_instances=sum(one.num_instances for one in rates),
    )


def _mean(rates: Sequence[tables.Figure]) -> str:
    values = [100 * float(one.value or 0) for one in rates]
    deviation = f" ± {np.std(values, ddof=1):.1f}" if len(values) > 1 else ""
    return f"{np.mean(values):.1f}{deviation}"


def _change(rates: Sequence[tables.Figure], baseline: Sequence[tables.Figure]) -> str:
    """Return the mean difference to the baseline and, of several seeds, its 95 % interval."""
    before = {one.seeds: one.value for one in baseline}
    pairs = [(one.value, before[one.seeds]) for one in rates if one.seeds in before]
    if not pairs:
        return ""
    points = 100 * np.subtract(*np.array(pairs, np.float64).T)
    count = len(points)
    text = f"{points.mean():+.1f}"
    if count < 2:
        return text
    half = t.ppf(0.975, count - 1) * points.std(ddof=1) / math.sqrt(count)
    return f"{text} [{points.mean() - half:+.1f}, {points.mean() + half:+.1f}]"


def parameter_rows(layout: PaperTable, methods: Mapping[str, Entry], folder: Path) -> Laid:
    """Return what was counted."""
    costs, missing = _costs(methods)
    counted = [
        {
            _METHOD: label,
            "backbone weights": f"{cost['backbone_weights']:,}",
            _PAPER: _printed(layout, label, "backbone weights"),
            "parameters": f"{cost['parameters']:,}",
            "GMACs": f"{cost['gmacs']:.3f}",
        }
        for label, cost in costs.items()
    ]
    return counted + missing, []


def time_rows(layout: PaperTable, methods: Mapping[str, Entry], folder: Path) -> Laid:
    """Return what was timed, then the paper's other methods; draw the frame rates (Fig. 13)."""
    costs, missing = _costs(methods)
    printed = f"{_PAPER}: ms/frame"
    rows = [
        {
            _METHOD: label,
            "ms/frame": f"{cost['ms_per_frame']:.1f}",
            printed: _printed(layout, label, "ms/frame"),
            "network ms": f"{cost['network_ms']:.1f}",
            "recovery ms": f"{cost['recovery_ms']:.1f}",
            f"network, frames/s, batch {cost['batch_size']}": f"{cost['frames_per_s']:.1f}",
            "pixels": "×".join(map(str, cost["input_size"])),
            "on": f"{cost['device']}, {cost['threads']} threads",
        }
        for label, cost in costs.items()
    ]
    others = [
        {_METHOD: label, printed: _printed(layout, label, "ms/frame")}
        for label in layout.paper
        if label not in methods
    ]
    if costs:
        jobs = {label: methods[label].runs[0].folder / FRAMES_FILE for label in costs}
        frames = {label: read_frames(path) for label, path in jobs.items()}
        save_frame_rates(folder / "frame_rate.png", frames)
    return rows + missing + others, []


def _printed(layout: PaperTable, label: str, measure: str) -> str:
    return _number(layout.paper.get(label, {}).get(_NETWORK, {}).get(measure))


def _costs(methods: Mapping[str, Entry]) -> tuple[dict[str, dict[str, Any]], list[tables.Row]]:
    """Return what each method's network costs, and rows of those of which nobody knows."""
    paths = {label: entry.runs[0].folder / COST_FILE for label, entry in methods.items()}
    costs = {label: read_json(path) for label, path in paths.items() if path.is_file()}
    return costs, [{_METHOD: _failed(one, methods[one])} for one in methods if one not in costs]


def _failed(label: str, entry: Entry) -> str:
    return f"{label}: {entry.failure or 'no such measurement'}"


KINDS: Final[Mapping[str, Callable[[PaperTable, Mapping[str, Entry], Path], Laid]]] = {
    "poses": pose_rows,
    "shading": shading_rows,
    "parameters": parameter_rows,
    "time": time_rows,
}
