"""Reports and run folders with known errors."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from dopepp.experiment.results.folder import FAILURE_FILE, METRICS_FILE, write_config, write_json
from dopepp.experiment.results.report import Cost, Report
from dopepp.metrics.pose import MEAN
from dopepp.metrics.row import PoseErrors, PoseRow, mean_row, summarise

DIAMETER = 0.1


def report_of(
    name: str,
    add: Sequence[float] | Mapping[str, Sequence[float]],
    *,
    refined: Sequence[float] | None = None,
    test_set: str = "images",
    num_symmetries: int = 1,
) -> Report:
    """Return a report of objects with these ADD errors (metres); 1 mm comes with 10°."""
    add = add if isinstance(add, Mapping) else {"part": add}
    errors = {part: np.array(values, np.float64) for part, values in add.items()}
    rows, constant = {}, {}
    for part, values in errors.items():
        e = torch.from_numpy(values)
        errors_of = PoseErrors(
            e, e, e, None, 10_000 * e, 10_000 * e, None, None, DIAMETER, num_symmetries
        )
        rows[part] = summarise(part, name, errors_of)
        rows[part].miss_rate = float(np.isinf(values).sum() / max(len(values), 1))
        constant[part] = PoseRow(part, "best constant pose", len(values), add_01d=0.2)
    rows[MEAN] = mean_row(list(rows.values()), name)
    constant[MEAN] = mean_row(list(constant.values()), "best constant pose")
    report = Report(
        name, rows, {"best constant pose": constant}, errors, Cost(1234567, 1.5, 7.25),
        sum(map(len, errors.values())),
        rotation_deg={part: 10_000 * values for part, values in errors.items()},
        diameters=dict.fromkeys(errors, DIAMETER), test_set=test_set,
    )  # fmt: skip
    if refined is not None:
        after = report_of(f"{name} + region", dict.fromkeys(errors, refined), test_set=test_set)
        report = replace(report, refined=after)
    return report


def write_run(
    folder: Path, overrides: Sequence[str] = (), result: Report | str | None = None, **config: Any
) -> Path:
    """Write what a run leaves: its report, or the reason of its failure."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(list(overrides)))
    if isinstance(result, Report):
        write_json(folder / METRICS_FILE, result.to_record())
        seed = next((int(text[5:]) for text in overrides if text.startswith("seed=")), 0)
        model = {"name": result.name, "width": 0.25}
        write_config(folder, {"model": model, "seed": seed, **config})
    elif result is not None:
        write_json(folder / FAILURE_FILE, {"reason": result})
    return folder


@pytest.fixture(name="report_of")
def make_report():
    return report_of


@pytest.fixture(name="write_run")
def make_run():
    return write_run
