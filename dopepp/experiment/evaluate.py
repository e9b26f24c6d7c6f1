"""Measuring methods on a test set, and writing down what came out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dopepp.core.errors import UserError
from dopepp.core.files import write_png
from dopepp.data.formats.bop.results import UNKNOWN_TIME, PoseResult, results_name, write_results
from dopepp.data.sample import Source
from dopepp.drawing.curves import save_accuracy_curves
from dopepp.drawing.sheet import contact_sheet
from dopepp.experiment.build.parts import build_parts
from dopepp.experiment.build.renders import scaled_test_renders
from dopepp.experiment.build.sources import held_out_source, share_in_words
from dopepp.experiment.config.data import DataConfig, chosen_data, trained_on
from dopepp.experiment.config.run import EvaluationConfig
from dopepp.experiment.reports import conditions, evaluators
from dopepp.experiment.reports.compare import compare_reports
from dopepp.experiment.reports.protocols import Protocols, record_breakdown
from dopepp.experiment.reports.report import Report, measure
from dopepp.experiment.reports.tables import reported_rates
from dopepp.experiment.runs import display, record
from dopepp.experiment.runs.images import warn_of_other_images
from dopepp.experiment.runs.readme import write_job_readme
from dopepp.experiment.tuning import FalsePositiveTarget, tune, write_tuned
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.refinement.refiner import Refine
from dopepp.inference.runtimes import is_export
from dopepp.models.network import PoseNetwork
from dopepp.parts.part import Part, Parts
from dopepp.recovery.silence import summary


def measure_and_record(
    estimators: Mapping[str, PoseEstimator],
    parts: Parts,
    data: DataConfig,
    run_dir: Path,
    num_pictures: int,
    details: Mapping[str, Any] | None = None,
    *,
    results: Mapping[str, Path] | None = None,
    bop_csv: bool = False,
    all_measures: bool = False,
    protocols: Protocols | None = None,
    refine: Refine | None = None,
) -> list[Report]:
    """Measure methods on a test set; show and write tables, curves and pictures.

    Estimators go by name, the baseline first where there is one, and so do ``results``, BOP
    challenge CSVs of other methods. The parts are those that are scored, as the test data have
    them; ``details`` are further plain facts for ``metrics.json``. ``bop_csv`` writes the poses of
    each method, ``all_measures`` prints the symmetric measures of every object. With ``refine``,
    every estimator is measured without and with it; ``metrics.json`` is the network's, with the
    refined poses' under ``refined``.

    Returns a report per estimator, then per file. A :class:`UserError`: data or a file are wrong.
    """
    protocols = protocols or Protocols()
    estimators = with_refined(estimators, refine, parts)
    source = held_out_source(data, parts, "test")
    numbers = evaluators.object_numbers(data, parts)
    files = {
        name: evaluators.FileMethod(path, parts, numbers) for name, path in (results or {}).items()
    }
    methods: dict[str, evaluators.Method] = {
        **{name: evaluators.EstimatorMethod(one, parts) for name, one in estimators.items()},
        **files,
    }
    if protocols.shading:
        conditions.SHADING.check_methods(methods)
        conditions.check_masks(source)
    if protocols.scales:
        conditions.SCALE.check_methods(methods)
    scaled = {one: scaled_test_renders(data, parts, one) for one in protocols.scales}
    samples = (source.sample(index, 0) for index in range(len(source)))
    is_bop = data.root is not None and data.format in ("bop", "webdataset")
    measured = measure(methods, samples, num_pictures, bop=is_bop and not data.is_rendered("test"))
    for file in files.values():
        file.check_used()
    reports = measured.reports
    # Of a network with and without refinement, the network's own result is what is compared.
    refines = refine is not None and not files
    main = reports[-2 if refines else -1]
    main.details.update(details or {})
    for report in reports:
        display.show_report(report, all_measures)
        if report.name in measured.bop:
            display.console.print(f"{report.name}: {measured.bop[report.name].in_words()}")
    _show_silence(methods, measured.silent, source)
    if refines:
        main.refined, share = reports[-1], made_worse(main, reports[-1])
        main.details["made_worse"] = share
        display.console.print(f"refinement made {share:.1%} of the instances worse by over 1 mm")
    record.write_json(run_dir / record.METRICS_FILE, main.to_record())
    if bop_csv:
        _write_results(run_dir, measured.poses, data, numbers)
    curves = {
        f"{report.name} {name}" if len(reports) > 1 else name: errors
        for report in reports
        for name, errors in report.errors.items()
    }
    save_accuracy_curves(run_dir / "auc", curves, title=f"{len(source)} test images")
    if measured.tiles:
        write_png(run_dir / "overlay.png", contact_sheet(measured.tiles))
    if len(reports) > 1:
        compare_reports(reports, run_dir, baseline=reports[0].name)
    rates = reported_rates(data, parts)
    for quantity in protocols.by:
        record_breakdown(run_dir, measured.metrics, quantity, protocols.num_bins, rates)
    if protocols.shading:
        shaded = conditions.measure_shading(
            methods, source, protocols.shading, data.eval_seed, reports, num_pictures
        )
        conditions.record_condition(run_dir, conditions.SHADING, *shaded, rates)
    if scaled:
        levels = conditions.measure_scales(methods, scaled, measured, num_pictures)
        conditions.record_condition(run_dir, conditions.SCALE, *levels, rates)
    display.show_files(run_dir)
    return reports


def _show_silence(
    methods: Mapping[str, evaluators.Method], silent: Mapping[str, Sequence[int]], source: Source
) -> None:
    """Print of every estimator on how many images it found nothing, and why."""
    for name, numbers in silent.items():
        method = methods[name]
        if numbers and isinstance(method, evaluators.EstimatorMethod):
            reasons = [method.silence(source.sample(number, 0)) for number in numbers]
            line = summary([one for one in reasons if one is not None], len(source))
            display.console.print(f"{name}: {line}")


def tune_and_record(
    estimator: PoseEstimator,
    path: Path,
    parts: Parts,
    data: DataConfig,
    run_dir: Path,
    target: FalsePositiveTarget,
) -> Path:
    """Tune a checkpoint (:func:`tune`), write it beside the old one, tell; return its path."""
    tuning = tune(estimator, data, parts, target)
    tuned = write_tuned(estimator.checkpoint, path, tuning.options)
    record.write_json(run_dir / "tuning.json", asdict(tuning))
    display.show_tuning(tuning, tuned)
    return tuned


def _write_results(
    run_dir: Path,
    poses: Mapping[str, Sequence[evaluators.MeasuredPose]],
    data: DataConfig,
    numbers: Mapping[str, int],
) -> None:
    """Write every method's poses as a BOP challenge CSV."""
    dataset, split = data.name, "test"
    if data.root is not None and not data.is_rendered("test"):
        dataset, split = data.root.resolve().name, data.image_set("test")
    for method, found in poses.items():
        rows = [
            PoseResult(
                *one.image,
                numbers[one.pose.object],
                one.pose.score,
                one.pose.T_cam_obj,
                UNKNOWN_TIME if one.seconds is None else one.seconds,
            )
            for one in found
        ]
        write_results(run_dir / results_name(method, dataset, split), rows)


def with_refined(
    estimators: Mapping[str, PoseEstimator], refine: Refine | None, parts: Parts
) -> dict[str, PoseEstimator]:
    """Return every estimator, and behind it the same one refining: two rows in every table."""
    pairs: dict[str, PoseEstimator] = {}
    for name, one in estimators.items():
        pairs[name] = one
        if refine is not None:
            terms = " + ".join([refine] if isinstance(refine, str) else refine)
            pairs[f"{name} + {terms}"] = refining(one, refine, parts)
    return pairs


def refining(estimator: PoseEstimator, refine: Refine | None, parts: Parts) -> PoseEstimator:
    """Return an estimator that refines, or for None the same one.

    A checkpoint of an earlier version, which has no meshes, takes those of ``parts``.
    """
    if refine is None:
        return estimator
    known = {part.name: part for part in parts}
    own = [part if part.mesh is not None else known.get(part.name, part)
           for part in estimator.parts]  # fmt: skip
    return estimator.refining(refine, own)


def made_worse(network: Report, refined: Report) -> float:
    """Return the share of instances whose ADD refinement has made larger by more than 1 mm."""
    pairs = [(network.errors[name], errors) for name, errors in refined.errors.items()]
    worse = np.concatenate([after > before + 0.001 for before, after in pairs])
    return float(worse.mean()) if len(worse) else 0.0


def parts_of(estimators: Sequence[PoseEstimator], data: DataConfig) -> list[Part]:
    """Return the last estimator's parts as the test data have them; without one, all of these."""
    if not estimators:
        return build_parts(data)
    names = [part.name for part in estimators[-1].parts]
    if data.root is not None and data.objects is None:
        data = replace(data, objects=tuple(names))
    available = {part.name: part for part in build_parts(data)}
    missing = [name for name in names if name not in available]
    if missing:
        raise UserError(
            f"test data without {', '.join(missing)}, which the checkpoint was trained on",
            ", ".join(names),
            "point data.root or data.parts to data of these objects",
        )
    return [available[name] for name in names]


def evaluate(config: Mapping[str, Any], run_dir: Path) -> list[Report]:
    """Parse ``evaluate.py``'s composed config and measure what it names on a test set.

    That is a checkpoint, a file of another method's poses, or both; the test set is the
    checkpoint's own one or another one. A :class:`UserError` tells what of it is wrong.
    """
    asked = EvaluationConfig.of(config)
    if asked.ckpt_path is None and asked.results is None:
        allowed = "ckpt_path=… or results=… on the command line"
        raise UserError("no ckpt_path", allowed, "add what is to be measured")
    paths = [path for path in (asked.baseline, asked.ckpt_path) if path is not None]
    device = asked.device
    if device == "auto":
        exported = any(is_export(Path(path)) for path in paths)
        device = "cuda" if torch.cuda.is_available() and not exported else "cpu"
    loaded = [PoseEstimator.load(path, device) for path in paths]
    own = loaded[-1].checkpoint if loaded else None
    measured = str(asked.results if own is None else paths[-1])
    stored = None if own is None else trained_on(own.data)
    data = chosen_data(asked.data, asked.virtual, stored, measured)
    record.write_config(run_dir, asked.plain)
    record.write_environment(run_dir, data.eval_seed, "" if own is None else own.data_fingerprint)
    parts = parts_of(loaded, data)
    share = share_in_words(data)
    if share is not None:
        display.console.print(share)
    if own is not None:
        warn_of_other_images(own, data, parts)
    if asked.tune:
        _tune_only(asked, loaded, parts, data, run_dir)
        return []
    file = None if asked.results is None else Path(asked.results)
    others = []
    if file is not None:  # BOP's file names begin with the method's
        others = [file.stem.partition("_")[0] if asked.method is None else str(asked.method)]
    names = _names(loaded, others)
    reports = measure_and_record(
        dict(zip(names, loaded, strict=False)),
        parts,
        data,
        run_dir,
        asked.num_pictures,
        results={} if file is None else {names[-1]: file},
        bop_csv=asked.bop_csv,
        all_measures=asked.all_measures,
        protocols=asked.protocols,
        refine=asked.refine,
    )
    write_job_readme(run_dir, f"Evaluation of {measured}", reports[-1])
    return reports


def _tune_only(
    asked: EvaluationConfig,
    loaded: Sequence[PoseEstimator],
    parts: Parts,
    data: DataConfig,
    run_dir: Path,
) -> None:
    """Tune the one checkpoint and measure nothing else."""
    if asked.protocols:
        raise UserError(
            "tune=true with shading, scale or by", "one of the two", "tune first, then measure"
        )
    if asked.ckpt_path is None or len(loaded) > 1:
        allowed = "one ckpt_path, and no baseline"
        raise UserError("tune=true", allowed, "tune one checkpoint at a time")
    if not isinstance(loaded[0].network, PoseNetwork):
        fix = "tune the checkpoint, then export the tuned one"
        raise UserError(f"tune=true of {asked.ckpt_path}, which is an export", "a checkpoint", fix)
    estimator = refining(loaded[0], asked.refine, parts)
    tune_and_record(estimator, Path(asked.ckpt_path), parts, data, run_dir, asked.false_positives)
    display.show_files(run_dir)


def _names(loaded: Sequence[PoseEstimator], others: Sequence[str]) -> list[str]:
    """Return the methods' names; of two with one name, the first is called the baseline."""
    names = [str(one.checkpoint.data.get("name", "estimate")) for one in loaded] + list(others)
    for number, name in enumerate(names[:-1]):
        if name in names[number + 1 :]:
            names[number] += " (baseline)" if number == 0 else " (checkpoint)"
    return names
