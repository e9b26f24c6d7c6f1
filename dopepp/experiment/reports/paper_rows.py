"""The rows of the paper's tables: what runs have measured, what the paper prints beside it.

To add a kind of table, write a function of layout, methods and folder that returns rows, and give
it a line in :data:`KINDS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from scipy.stats import t

from dopepp.core.files import write_png
from dopepp.drawing.curves import RateCurve, figure_image, rates_figure
from dopepp.experiment.cost import COST_FILE, FRAMES_FILE, read_frames, save_frame_rates
from dopepp.experiment.reports.compare.entries import Entry, differences
from dopepp.experiment.reports.compare.runs import Run
from dopepp.experiment.reports.compare.table import Line, interval, with_deviation
from dopepp.experiment.reports.shading import SHADING
from dopepp.experiment.reports.tables import Row, heading, read_csv
from dopepp.experiment.runs import record
from dopepp.metrics.functional import wilson_interval
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import COLUMNS

Figures = Mapping[str, Mapping[str, Mapping[str, float]]]
"""Figures by label, object and measure."""

LABELS: Final = ("method", "object", "measure")
"""Headings of what is no number."""

_METHOD, _OBJECT, _MEASURE = LABELS
_COLUMNS: Final = {column.field: column for column in COLUMNS}
_STRICT: Final = "add_01d"
_NETWORK: Final = "network"
"""What stands for the object, where there is none."""
_PAPER: Final = "the paper"
_CONFIDENCE: Final = 0.95


_Rates = dict[float, dict[int | None, tuple[float, int]]]
"""By share and seed: the rate and the number of instances."""


class Layout(Protocol):
    """What rows need to know of a table; a ``PaperTable`` has it."""

    @property
    def pass_field(self) -> str:
        """Field of the paper's pass rate."""

    @property
    def paper(self) -> Figures:
        """What the paper prints."""

    @property
    def recomputed(self) -> Figures:
        """Other methods, measured with this project's functions."""


def pose_rows(table: Layout, methods: Mapping[str, Entry], folder: Path) -> list[Row]:
    """Return, object by object, a row per method: the paper's measures, then stricter ones.

    The first method with a result is what Δ is against. The reference rows stand at the end.
    """
    measured = [entry for entry in methods.values() if entry.reports]
    objects = list(dict.fromkeys(name for entry in measured for name in entry.objects))
    if not objects:  # nothing was measured: the paper's figures and why there are no others
        objects = list(dict.fromkeys(name for one in table.paper.values() for name in one))
    others = [name for name in (*table.recomputed, *table.paper) if name not in methods]
    rows = [
        _pose_row(table, label, name, methods.get(label), measured, objects)
        for name in objects
        for label in [*methods, *dict.fromkeys(others)]
        if label in methods or _known(table, label, name)
    ]
    for name in objects if measured else ():
        for reference, by_object in measured[0].reports[0].references.items():
            if name in by_object:
                line = Line(reference, name, None, by_object[name])
                rows.append(_cells(table, line, {}))
    return rows


def _known(table: Layout, label: str, name: str) -> bool:
    return any(name in figures.get(label, {}) for figures in (table.paper, table.recomputed))


def _pose_row(
    table: Layout,
    label: str,
    name: str,
    entry: Entry | None,
    measured: Sequence[Entry],
    objects: Sequence[str],
) -> Row:
    """Return one method's row on one object; the paper's mean stands beside one of its objects."""
    figures = table.paper.get(label, {})
    is_other_mean = name == MEAN and set(figures) != set(objects)
    printed = {} if is_other_mean else figures.get(name, {})
    if entry is None:
        own = table.recomputed.get(label, {}).get(name, {})
        return _cells(table, Line(label, name), printed, own)
    if not entry.reports or name not in entry.objects:
        failure = entry.failure or "not measured on it"
        return _cells(table, Line(f"{label}: {failure}", name), printed)
    is_baseline = entry is measured[0]
    known = {} if is_baseline else differences(entry, measured[0], name)
    return _cells(table, Line(label, name, entry, entry.row(name), known), printed)


def _cells(
    table: Layout,
    line: Line,
    printed: Mapping[str, float],
    recomputed: Mapping[str, float] | None = None,
) -> Row:
    """Return the cells of a row: every measure, the paper's figure and Δ behind it."""
    row = {_METHOD: line.method, _OBJECT: line.object}
    for field, key, has_difference in (
        (table.pass_field, "pass", True),
        ("auc_10cm", "auc_10cm", False),
        (_STRICT, _STRICT, True),
        ("median_rotation_deg", "median_rotation_deg", False),
    ):
        column = _COLUMNS[field]
        text = column.heading
        if line.row is not None:
            row[text] = with_deviation(line, column)
        else:
            row[text] = _text((recomputed or {}).get(key))
        if key in ("pass", "auc_10cm"):
            row[f"{_PAPER}: {text}"] = _text(printed.get(key))
        if has_difference:
            row[f"Δ {text}"] = interval(line, column)
    return row


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:,}"


def shading_rows(table: Layout, methods: Mapping[str, Entry], folder: Path) -> list[Row]:
    """Return pass rates at every share, the paper's and Δ beside them; draw them for all methods.

    Rates are means over seeds. Δ is to the first method at the same share; its interval is
    Student's t of the differences of equal seeds.
    """
    measured = {label: _shading(entry.runs) for label, entry in methods.items()}
    rows: list[Row] = []
    panels: dict[str, dict[str, RateCurve]] = {}
    for label in (one for one in methods if not measured[one]):
        rows.append({_METHOD: _failed(label, methods[label]), _OBJECT: "", _MEASURE: ""})
    known = {label: one for label, one in measured.items() if one}
    for name in dict.fromkeys(name for one in known.values() for name in one):
        for field in (table.pass_field, _STRICT):
            baseline: _Rates | None = None
            for label in (one for one in known if name in known[one]):
                rates = known[label][name][field]
                head = {_METHOD: label, _OBJECT: name, _MEASURE: heading(field)}
                rows.append({**head, **{f"{100 * s:g} %": _mean(rates, s) for s in rates}})
                if baseline is not None:
                    changes = {f"{100 * s:g} %": _change(rates, baseline, s) for s in rates}
                    rows.append({**head, _METHOD: f"Δ {label}", **changes})
                baseline = baseline or rates
                printed = table.paper.get(label, {}).get(name, {})
                if printed and field == table.pass_field:
                    texts = {share: _text(value) for share, value in printed.items()}
                    rows.append({**head, _METHOD: f"{label}, {_PAPER}", **texts})
                panels.setdefault(f"{name}: {heading(field)}", {})[label] = _curve(rates)
    if panels:
        figure = rates_figure(panels, SHADING.axis, 2)
        write_png(folder / "table_shading.png", figure_image(figure))
    return rows


def _shading(runs: Sequence[Run]) -> dict[str, dict[str, _Rates]]:
    """Return what runs have measured, by object and field; of one network a part, the mean, too."""
    found: dict[str, dict[str, _Rates]] = {}
    for run in runs:
        for row in read_csv(run.folder / SHADING.table_file):
            for field in (key for key in row if key in _COLUMNS and row[key]):
                by_share = found.setdefault(row["object"], {}).setdefault(field, {})
                seeds = by_share.setdefault(float(row["share"]), {})
                seeds[run.seed] = float(row[field]), int(row["num_instances"])
    if len(found) > 1 and MEAN not in found:
        found[MEAN] = _mean_rates(list(found.values()))
    return found


def _mean_rates(parts: Sequence[dict[str, _Rates]]) -> dict[str, _Rates]:
    """Average over parts what all of them have: field, share and seed."""
    first, *others = parts
    mean: dict[str, _Rates] = {}
    for field, by_share in first.items():
        for share, by_seed in by_share.items():
            for seed in by_seed:
                try:
                    known = [one[field][share][seed] for one in (first, *others)]
                except KeyError:  # a part without this measurement
                    continue
                pair = float(np.mean([rate for rate, _ in known])), sum(num for _, num in known)
                mean.setdefault(field, {}).setdefault(share, {})[seed] = pair
    return mean


def _mean(rates: _Rates, share: float) -> str:
    values = [100 * rate for rate, _ in rates[share].values()]
    deviation = f" ± {np.std(values, ddof=1):.1f}" if len(values) > 1 else ""
    return f"{np.mean(values):.1f}{deviation}"


def _change(rates: _Rates, baseline: _Rates, share: float) -> str:
    """Return the mean difference to the baseline and, of several seeds, its 95 % interval."""
    before = baseline.get(share, {})
    pairs = [(rates[share][seed][0], before[seed][0]) for seed in rates[share] if seed in before]
    if not pairs:
        return ""
    points = 100 * np.subtract(*np.array(pairs).T)
    count = len(points)
    text = f"{points.mean():+.1f}"
    if count < 2:
        return text
    half = t.ppf((1 + _CONFIDENCE) / 2, count - 1) * points.std(ddof=1) / math.sqrt(count)
    return f"{text} [{points.mean() - half:+.1f}, {points.mean() + half:+.1f}]"


def _curve(rates: _Rates) -> RateCurve:
    """Return the mean rate against the share, percent, with Wilson's interval."""
    points = []
    for share, by_seed in rates.items():
        mean = float(np.mean([rate for rate, _ in by_seed.values()]))
        count = sum(num for _, num in by_seed.values())
        points.append((100 * share, mean, *wilson_interval(round(mean * count), count)))
    return RateCurve(*np.array(points, np.float64).T)


def parameter_rows(table: Layout, methods: Mapping[str, Entry], folder: Path) -> list[Row]:
    """Return what was counted."""
    counted = [
        {
            _METHOD: label,
            "backbone weights": f"{cost['backbone_weights']:,}",
            _PAPER: _printed(table, label, "backbone weights"),
            "parameters": f"{cost['parameters']:,}",
            "GMACs": f"{cost['gmacs']:.3f}",
        }
        for label, _, cost in _costs(methods)
    ]
    return counted + _not_measured(methods)


def time_rows(table: Layout, methods: Mapping[str, Entry], folder: Path) -> list[Row]:
    """Return what was timed, then the paper's other methods; draw the frame rates (Fig. 13)."""
    rows, frames = [], {}
    for label, entry, cost in _costs(methods):
        frames[label] = read_frames(entry.runs[0].folder / FRAMES_FILE)
        width, height = cost["input_size"]
        rows.append(
            {
                _METHOD: label,
                "ms/frame": f"{cost['ms_per_frame']:.1f}",
                f"{_PAPER}: ms/frame": _printed(table, label, "ms/frame"),
                "network ms": f"{cost['network_ms']:.1f}",
                "recovery ms": f"{cost['recovery_ms']:.1f}",
                f"network, frames/s, batch {cost['batch_size']}": f"{cost['frames_per_s']:.1f}",
                "pixels": f"{width}×{height}",
                "on": f"{cost['device']}, {cost['threads']} threads",
            }
        )
    rows += _not_measured(methods)
    rows += [
        {_METHOD: label, f"{_PAPER}: ms/frame": _printed(table, label, "ms/frame")}
        for label in table.paper
        if label not in methods
    ]
    if frames:
        save_frame_rates(folder / "frame_rate.png", frames)
    return rows


def _printed(table: Layout, label: str, measure: str) -> str:
    return _text(table.paper.get(label, {}).get(_NETWORK, {}).get(measure))


def _costs(methods: Mapping[str, Entry]) -> Iterator[tuple[str, Entry, dict[str, Any]]]:
    for label, entry in methods.items():
        cost = _read_cost(entry)
        if cost is not None:
            yield label, entry, cost


def _not_measured(methods: Mapping[str, Entry]) -> list[Row]:
    return [
        {_METHOD: _failed(label, entry)}
        for label, entry in methods.items()
        if _read_cost(entry) is None
    ]


def _read_cost(entry: Entry) -> dict[str, Any] | None:
    path = entry.runs[0].folder / COST_FILE
    return record.read_json(path) if path.is_file() else None


def _failed(label: str, entry: Entry) -> str:
    return f"{label}: {entry.failure or 'no such measurement'}"


KINDS: Final[Mapping[str, Callable[[Layout, Mapping[str, Entry], Path], list[Row]]]] = {
    "poses": pose_rows,
    "shading": shading_rows,
    "parameters": parameter_rows,
    "time": time_rows,
}
