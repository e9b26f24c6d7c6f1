"""Write the runs of a sweep as a table in the paper's layout, next to the paper's values.

A config describes its table under ``table`` (see ``conf/experiment/``).
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal

import pandas as pd
from scipy.stats import t

from dopepp.core.errors import UserError
from dopepp.core.files import write_csv, write_png
from dopepp.core.validation import STRICT, parse
from dopepp.core.yaml import read_yaml
from dopepp.drawing.curves import figure_image, rates_figure
from dopepp.experiment.config.run_config import AUTO
from dopepp.experiment.results import display
from dopepp.experiment.results.compared_runs import Entry
from dopepp.experiment.results.conditions import SHADING
from dopepp.experiment.results.cost import FRAMES_FILE, NOTE, save_frame_rates
from dopepp.experiment.results.differences import (
    REFINED_NOTE,
    comparison_values,
    noise_notes,
    width_notes,
)
from dopepp.experiment.results.folder import COST_FILE, read_json
from dopepp.experiment.results.frame import (
    ADD_5CM,
    ADD_10CM,
    DELTA,
    Row,
    Value,
    header_of,
    heading,
    interval,
    markdown,
    rate_curves,
    row_values,
)
from dopepp.experiment.results.pages import write_page
from dopepp.metrics.pose import MEAN

TEXT_FILE: Final = "table.md"
TABLE_FILE: Final = "table.csv"

Printed = Mapping[str, Mapping[str, Mapping[str, int | float]]]  # by label, object and measure

_LABELS: Final = ("method", "object", "measure")  # headings of text columns
_METHOD, _OBJECT, _MEASURE = _LABELS
_STRICT: Final = "add_01d"
_PAPER: Final = "the paper"
_PASS_FIELDS: Final = {rate.threshold: rate.field for rate in (ADD_5CM, ADD_10CM)}
_MEASURED: Final = ("poses", "shading")  # kinds of tables that need trained networks


@dataclass(frozen=True)
class PaperTable:
    """Layout of the table of a sweep.

    A printed measure is a field of ``PoseRow`` (``pass`` for the paper's pass rate) or a heading.
    """

    __pydantic_config__ = STRICT
    title: str  # with the paper's table number
    kind: Literal["poses", "shading", "parameters", "time"] = "poses"  # a key of `KINDS`
    threshold: float = 0.05  # of the paper's pass rate, metres; 0.1 for YCB-Video
    labels: Mapping[str, str] = dataclasses.field(default_factory=dict)  # by override; joined
    paper: Printed = dataclasses.field(default_factory=dict)  # values, rates in percent
    recomputed: Printed = dataclasses.field(default_factory=dict)  # with functions of this project
    notes: tuple[str, ...] = ()  # below the table

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> PaperTable:
        """Read the config's ``table``."""
        table = parse(cls, config, "table")
        if table.threshold not in _PASS_FIELDS:
            allowed = ", ".join(f"{threshold:g}" for threshold in _PASS_FIELDS)
            fix = "set table.threshold to one of these numbers"
            raise UserError(f"table.threshold={table.threshold}", f"{allowed}, metres", fix)
        return table

    @classmethod
    def read(cls, path: Path) -> PaperTable:
        """Read the ``table`` of an experiment's file, ``conf/experiment/NAME.yaml``."""
        config = read_yaml(path)
        table = config.get("table") if isinstance(config, dict) else None
        if not isinstance(table, dict):
            raise UserError(
                f"{path}, which has no table layout",
                "an experiment with `table:`",
                "pass e.g. conf/experiment/table4_parameters.yaml",
            )
        return cls.of(table)

    @property
    def pass_field(self) -> str:
        """Field of ``PoseRow`` with the paper's pass rate."""
        return _PASS_FIELDS[self.threshold]

    def field(self, key: str) -> str:
        """Return the field of ``PoseRow`` for a measure in the config, such as ``pass``."""
        return self.pass_field if key == "pass" else key

    def printed(self, label: str, measure: str) -> str:
        """Return the text of a measure that the paper prints for a network; empty without any."""
        return _number(self.paper.get(label, {}).get("network", {}).get(measure))

    def methods(self, entries: Sequence[Entry]) -> dict[str, Entry]:
        """Return the methods by their label in the paper, composed from the overrides of a run.

        Methods whose label is missing or not unique keep their own name.
        """
        called = []
        for entry in entries:
            used = entry.runs[0].overrides if entry.runs else []
            label = " ".join(self.labels[key] for key in self.labels if key in used)
            refine = f" + {entry.refine}" if label and entry.refine else ""
            called.append(f"{label}{refine}" or entry.name)
        count = Counter(called)
        return {
            label if count[label] == 1 else entry.name: entry
            for label, entry in zip(called, entries, strict=True)
        }


def write_paper_table(table: PaperTable, entries: Sequence[Entry], folder: Path) -> None:
    """Print a table and write ``table.md`` and ``table.csv``; for Tables 3 and 8, also a figure."""
    title, notes = table.title, list(table.notes)
    configs = [run.config for entry in entries for run in entry.runs]
    if table.kind in _MEASURED:
        if recipes := sorted({str(config.get("recipe")) for config in configs} & {"ours", "paper"}):
            title += f", recipe={' and '.join(recipes)}"
        notes.append(f"The paper's pass rate is ADD < {table.threshold:g} m.")
        if any(entry.refine for entry in entries):
            notes.append(REFINED_NOTE)
        if any(map(_starts_untrained, configs)):
            sentence = "DOPE's VGG19 started untrained, because nothing is downloaded"
            option = "model.backbone.weights_path=FILE"
            notes.append(f"{sentence}; {option} loads weights in torchvision's format.")
    else:  # refinement does not affect the cost of a network
        entries = [entry for entry in entries if not entry.refine]
        notes += [NOTE] if table.kind == "time" else []
    if not table.paper:
        notes.append("The paper has no table of these values.")
    notes += width_notes(entries)
    rows, doubts = KINDS[table.kind](table, table.methods(entries), folder)
    display.show_table(title, rows, num_labels=sum(key in _LABELS for key in rows[0]))
    write_csv(folder / TABLE_FILE, rows, header_of(rows))
    table_and_notes = {"table": markdown(rows), "notes": [*notes, *doubts]}
    write_page(folder / TEXT_FILE, "table", title=title, **table_and_notes)


def _starts_untrained(config: Mapping[str, Any]) -> bool:
    """Return whether the VGG19 of a run's network started without pretrained weights."""
    model = config.get("model")
    backbone = model.get("backbone") if isinstance(model, dict) else None
    if not isinstance(backbone, dict) or config.get("init_from") not in (None, AUTO):
        return False
    is_vgg = backbone.get("_target_") == "dopepp.models.backbones.VGG19"
    return is_vgg and backbone.get("weights_path") is None


RowsAndNotes = tuple[list[Row], list[str]]  # rows of a table, and notes on their uncertainty


def pose_rows(layout: PaperTable, methods: Mapping[str, Entry], folder: Path) -> RowsAndNotes:
    """Return a row per object and method: pass rates, AUC, rotation error and paper's values.

    The reference rows come last.
    """
    values = comparison_values([replace(entry, name=label) for label, entry in methods.items()])
    texts: dict[tuple[str, str], Row] = {}
    for value in values:
        texts.setdefault((value.method, value.object), {})[value.measure] = value.summary
    measured = [entry for entry in methods.values() if entry.reports]
    objects = list(dict.fromkeys(name for entry in measured for name in entry.objects))
    if not objects:  # without measurements, show the paper's values and the reasons
        objects = list(dict.fromkeys(name for row in layout.paper.values() for name in row)) or [""]
    rows = []
    for name in objects:
        for label in dict.fromkeys([*methods, *layout.recomputed, *layout.paper]):
            in_paper = layout.paper.get(label, {})
            recomputed = layout.recomputed.get(label, {})
            # The paper's mean only applies to the same set of objects.
            is_other_mean = name == MEAN and set(in_paper) != set(objects)
            printed = {} if is_other_mean else in_paper.get(name, {})
            entry = methods.get(label)
            if entry is not None and name in entry.objects:
                rows.append(_pose_row(layout, label, name, texts[label, name], printed))
            elif entry is not None:
                reason = f"{label}: {entry.failure or 'not measured on this object'}"
                rows.append(_pose_row(layout, reason, name, {}, printed))
            elif name in in_paper or name in recomputed:
                numbers = recomputed.get(name, {}).items()
                cells = {layout.field(key): _number(number) for key, number in numbers}
                rows.append(_pose_row(layout, label, name, cells, printed))
    for name in objects if measured else ():
        for by_object in measured[0].reports[0].references.values():
            if name in by_object:
                row = by_object[name]
                cells = {value.measure: value.text for value in row_values(row)}
                rows.append(_pose_row(layout, row.method, name, cells, {}))
    return rows, noise_notes(values)


def _pose_row(
    layout: PaperTable, method: str, name: str, texts: Row, printed: Mapping[str, float]
) -> Row:
    """Return a table row with the ``texts`` by field and the paper's values by key, ``printed``."""
    row = {_METHOD: method, _OBJECT: name}
    for key in ("pass", "auc_10cm", _STRICT, "median_rotation_deg"):
        measure = layout.field(key)
        title = heading(measure)
        row[title] = texts.get(measure, "")
        if key in ("pass", "auc_10cm"):
            row[f"{_PAPER}: {title}"] = _number(printed.get(key))
        if key in ("pass", _STRICT):
            row[f"{DELTA}{title}"] = texts.get(f"{DELTA}{measure}", "")
    return row


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:,}"


def shading_rows(layout: PaperTable, methods: Mapping[str, Entry], folder: Path) -> RowsAndNotes:
    """Return the pass rates at every covered share, the paper's and Δ, and plot their curves.

    Rates are means over seeds. Δ refers to the first method at the same share, or to the first
    refined method for refined poses, with Student's t interval of differences of equal seeds.
    """
    measures = layout.pass_field, _STRICT
    tables = {label: _shading(label, entry, measures) for label, entry in methods.items()}
    rows: list[Row] = [
        {_METHOD: _failed(label, methods[label]), _OBJECT: "", _MEASURE: ""}
        for label, table in tables.items()
        if table.empty
    ]
    everything, panels = pd.concat(list(tables.values())), {}
    for name, measure in product(everything["object"].unique(), measures):
        table = everything[everything[["object", "measure"]].eq([name, measure]).all(axis=1)]
        head = {_OBJECT: name, _MEASURE: heading(measure)}
        firsts: dict[str, pd.DataFrame] = {}  # rates of the first method by kind of refinement
        for label, rows_of_label in table.groupby("method", sort=False):
            rates = 100 * rows_of_label.pivot(index="seed", columns="share", values="rate")
            rows.append({_METHOD: label, **head, **_by_share(rates, _mean)})
            refine = methods[label].refine
            if firsts:
                change = rates - firsts.get(refine, next(iter(firsts.values())))
                changes = _by_share(change[rates.columns], _change)
                rows.append({_METHOD: f"{DELTA}{label}", **head, **changes})
            firsts.setdefault(refine, rates)
            printed = layout.paper.get(label, {}).get(name, {})
            if printed and measure == layout.pass_field:
                numbers = {share: _number(value) for share, value in printed.items()}
                rows.append({_METHOD: f"{label}, {_PAPER}", **head, **numbers})
        panels[f"{name}: {heading(measure)}"] = rate_curves(pooled_rates(table), SHADING.per_unit)
    if panels:
        figure = rates_figure(panels, SHADING.axis, 2)
        write_png(folder / "table_shading.png", figure_image(figure))
    return rows, []


def _shading(label: str, entry: Entry, measures: Sequence[str]) -> pd.DataFrame:
    """Return a table of a method's pass rates by object, measure, covered share and seed.

    The file of a run may contain other methods. The mean over objects is added if each network was
    trained on one part.
    """
    columns = ["object", "share", "num_instances", *measures]
    tables = [pd.DataFrame(columns=["seed", *columns])]
    for run in entry.runs:
        report = run.report.refined if run.report and entry.refine else run.report
        path = run.folder / f"{SHADING.name}.csv"
        if report is not None and path.is_file():
            table = pd.read_csv(path)
            table = table[table["method"] == report.name].reindex(columns=columns)
            tables.append(table.assign(seed=str(run.seed)))
    keys = ["object", "measure", "share", "seed"]
    rates = pd.concat([table for table in tables if len(table)] or tables)
    rates = rates.melt(["seed", *columns[:3]], list(measures), "measure", "rate")
    rates = rates.dropna(subset="rate").drop_duplicates(keys, keep="last")
    objects = rates["object"].unique()
    if len(objects) > 1 and MEAN not in objects:
        groups = rates.groupby(keys[1:], sort=False)
        mean = groups.agg(rate=("rate", "mean"), num_instances=("num_instances", "sum"))
        # The mean is restricted to shares and seeds that all parts have.
        whole = mean[groups.size() == len(objects)].reset_index()
        rates = pd.concat([rates, whole.assign(object=MEAN)])
    return rates.assign(method=label)


def pooled_rates(rates: pd.DataFrame) -> Iterator[Value]:
    """Yield the mean rate of each method and share, with Wilson's interval.

    All seeds are measured on the same instances, which the interval counts once.
    """
    for (method, share), seeds in rates.groupby(["method", "share"], sort=False):
        rate = float(seeds["rate"].mean())
        low, high = interval(rate, int(seeds["num_instances"].min()))
        yield Value(method, "", value=rate, condition=share, low=low, high=high)


def _by_share(points: pd.DataFrame, text: Callable[[pd.Series[float]], str]) -> Row:
    """Return, by heading of each covered share, the ``text`` of the numbers of all seeds."""
    return {SHADING.heading(share): text(column.dropna()) for share, column in points.items()}


def _mean(rates: pd.Series[float]) -> str:
    return f"{rates.mean():.1f}" + (f" ± {rates.std():.1f}" if len(rates) > 1 else "")


def _change(points: pd.Series[float]) -> str:
    """Return the mean difference to the baseline and its 95 % interval over several seeds."""
    count, mean = len(points), points.mean()
    if count < 2:
        return f"{mean:+.1f}" if count else ""
    half = t.ppf(0.975, count - 1) * points.std() / math.sqrt(count)
    return f"{mean:+.1f} [{mean - half:+.1f}, {mean + half:+.1f}]"


def parameter_rows(layout: PaperTable, methods: Mapping[str, Entry], folder: Path) -> RowsAndNotes:
    """Return a row per network: parameters, multiply-accumulates (10⁹) and the paper's value."""

    def row(label: str, cost: Mapping[str, Any]) -> Row:
        return {
            "backbone weights": f"{cost['backbone_weights']:,}",
            _PAPER: layout.printed(label, "backbone weights"),
            "parameters": f"{cost['parameters']:,}",
            "GMACs": f"{cost['gmacs']:.3f}",
        }

    return _cost_rows(methods, row), []


def time_rows(layout: PaperTable, methods: Mapping[str, Entry], folder: Path) -> RowsAndNotes:
    """Return a row per network and per other method of the paper; plot the frame rates."""
    printed = f"{_PAPER}: ms/frame"

    def row(label: str, cost: Mapping[str, Any]) -> Row:
        return {
            "ms/frame": f"{cost['ms_per_frame']:.1f}",
            printed: layout.printed(label, "ms/frame"),
            "network ms": f"{cost['network_ms']:.1f}",
            "recovery ms": f"{cost['recovery_ms']:.1f}",
            f"network, frames/s, batch {cost['batch_size']}": f"{cost['frames_per_s']:.1f}",
            "pixels": "×".join(map(str, cost["input_size"])),
            "on": f"{cost['device']}, {cost['threads']} threads",
        }

    others = [label for label in layout.paper if label not in methods]
    rows = [{_METHOD: label, printed: layout.printed(label, "ms/frame")} for label in others]
    jobs = {label: entry.runs[0].folder / FRAMES_FILE for label, entry in methods.items()}
    frames = {label: pd.read_csv(path) for label, path in jobs.items() if path.is_file()}
    if frames:
        save_frame_rates(folder / "frame_rate.png", frames)
    return _cost_rows(methods, row) + rows, []


def _cost_rows(
    methods: Mapping[str, Entry], row: Callable[[str, Mapping[str, Any]], Row]
) -> list[Row]:
    """Return a row per network with a cost file, then a row per network that failed."""
    paths = {label: entry.runs[0].folder / COST_FILE for label, entry in methods.items()}
    costs = {label: read_json(path) for label, path in paths.items() if path.is_file()}
    rows = [{_METHOD: label, **row(label, cost)} for label, cost in costs.items()]
    failed = [_failed(label, methods[label]) for label in methods if label not in costs]
    return rows + [{_METHOD: text} for text in failed]


def _failed(label: str, entry: Entry) -> str:
    """Return a network's label with the reason why it was not measured."""
    return f"{label}: {entry.failure or 'not measured'}"


KINDS: Final[Mapping[str, Callable[[PaperTable, Mapping[str, Entry], Path], RowsAndNotes]]] = {
    "poses": pose_rows,
    "shading": shading_rows,
    "parameters": parameter_rows,
    "time": time_rows,
}
