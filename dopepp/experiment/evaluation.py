"""Measuring checkpoints on a test set, and writing down what came out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from dopepp.drawing.curves import save_accuracy_curves
from dopepp.drawing.png import write_png
from dopepp.drawing.sheet import contact_sheet
from dopepp.errors import UserError
from dopepp.experiment import display, record
from dopepp.experiment.compare import compare
from dopepp.experiment.objects import build_parts
from dopepp.experiment.report import Report, measure
from dopepp.experiment.sources import build_test_source
from dopepp.inference.estimator import PoseEstimator
from dopepp.parts.part import Part


def measure_and_record(
    estimators: Mapping[str, PoseEstimator],
    data: Mapping[str, Any],
    seed: int,
    run_dir: Path,
    num_pictures: int,
    details: Mapping[str, Any] | None = None,
) -> list[Report]:
    """Measure estimators on a test set; show and write tables, curves and pictures."""
    last = list(estimators.values())[-1]
    parts = _parts_of(last, data)
    source = build_test_source(data, parts, seed)
    samples = (source.sample(index, 0) for index in range(len(source)))
    reports, tiles = measure(estimators, samples, num_pictures)
    reports[-1].details.update(details or {})
    for report in reports:
        display.show_report(report)
    record.write_json(run_dir / record.METRICS_FILE, reports[-1].to_record())
    curves = {
        f"{report.name} {name}" if len(reports) > 1 else name: errors
        for report in reports
        for name, errors in report.errors.items()
    }
    save_accuracy_curves(run_dir / "auc", curves, title=f"{len(source)} test images")
    if tiles:
        write_png(run_dir / "overlay.png", contact_sheet(tiles))
    if len(reports) > 1:
        compare(reports, run_dir, baseline=reports[0].name)
    display.show_files(run_dir)
    return reports


def _parts_of(estimator: PoseEstimator, data: Mapping[str, Any]) -> list[Part]:
    """Return the estimator's parts with the meshes and points that the test data have for them."""
    names = [part.name for part in estimator.parts]
    if data["root"] is not None and data["objects"] is None:
        data = {**data, "objects": names}
    available = {part.name: part for part in build_parts(data)}
    missing = [name for name in names if name not in available]
    if missing:
        raise UserError(
            f"test data without {', '.join(missing)}, which the checkpoint was trained on",
            ", ".join(names),
            "point data.root or data.parts to data of these objects",
        )
    return [available[name] for name in names]


def evaluate(config: dict[str, Any], run_dir: Path) -> list[Report]:
    """Measure a checkpoint, and a baseline beside it, on its own test set or another one.

    Args:
        config: The composed and resolved evaluation config, plain values.
        run_dir: Folder that everything is written to.

    Raises:
        UserError: A checkpoint, an option or the data are wrong.
    """
    device = config["device"]
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    paths = [path for path in (config["baseline"], config["ckpt_path"]) if path is not None]
    loaded = [PoseEstimator.load(path, device) for path in paths]
    own = loaded[-1].checkpoint
    stored = own.data
    data = chosen_data(config, stored.get("config"), str(config["ckpt_path"]))
    record.write_config(run_dir, config)
    environment = record.environment(int(config["seed"]), own.data_fingerprint)
    record.write_json(run_dir / record.VERSIONS_FILE, environment)
    seed = int(stored.get("seed", config["seed"]))
    estimators = dict(zip(_names(loaded), loaded, strict=True))
    return measure_and_record(estimators, data, seed, run_dir, config["num_pictures"])


def chosen_data(config: Mapping[str, Any], stored: object, checkpoint: str) -> dict[str, Any]:
    """Return the data config to evaluate on: the checkpoint's, with what the user gives instead.

    Args:
        config: May have ``data`` (whole, or the options to change) and ``virtual`` (options to
            change).
        stored: What the checkpoint was trained on.
        checkpoint: Its path, for messages.

    Raises:
        UserError: Neither names the data, or an option does not exist.
    """
    given = config.get("data") or {}
    whole = "name" in given  # a file of conf/data, not single options
    if not whole and not isinstance(stored, dict):
        raise UserError(
            f"{checkpoint}, which names no data", "data=… on the command line", "add it"
        )
    base = stored if isinstance(stored, dict) else {}
    data = dict(given) if whole else _changed(base, given, "data")
    data["virtual"] = _chosen_virtual(config.get("virtual") or {}, base.get("virtual"), checkpoint)
    return {**data, "test": {"renderer": None, "cache": "none", **(data.get("test") or {})}}


def _chosen_virtual(
    given: Mapping[str, Any], stored: Mapping[str, Any] | None, checkpoint: str
) -> dict[str, Any]:
    """Return how to render: a whole node as given, or the stored one with options changed."""
    if "renderer" in given and "preset" in given:  # a file of conf/virtual, not single options
        return dict(given)
    if stored is None:
        raise UserError(
            f"{checkpoint}, which does not say how to render", "virtual=default", "add it"
        )
    return _changed(stored, given, "virtual")


def _changed(base: Mapping[str, Any], changes: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Replace options, one by one also inside groups; ``scene`` takes any key."""
    merged = dict(base)
    for key, value in changes.items():
        if key not in base and not where.startswith("virtual.scene"):
            raise UserError(
                f"{where}.{key}={value}", ", ".join(map(str, base)), "check the option's name"
            )
        nested = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _changed(base[key], value, f"{where}.{key}") if nested else value
    return merged


def _names(loaded: list[PoseEstimator]) -> list[str]:
    """Return the models' names; of two with one name, the first is called the baseline."""
    names = [str(one.checkpoint.data.get("name", "estimate")) for one in loaded]
    if len(set(names)) < len(names):
        names[0] += " (baseline)"
    return names
