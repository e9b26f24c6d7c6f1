"""Measure methods and write tables, curves, images and poses into the run folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dopepp.core.files import write_png
from dopepp.data.formats.bop.bop_results import UNKNOWN_TIME, BopResult, results_name, write_results
from dopepp.data.sample import SampleSource
from dopepp.drawing.curves import RateCurve, coverage_figure, figure_image, save_accuracy_curves
from dopepp.drawing.sheet import contact_sheet
from dopepp.experiment.assembly.build_sources import held_out_source
from dopepp.experiment.assembly.renders import scaled_test_renders
from dopepp.experiment.assembly.static_scenes import with_views
from dopepp.experiment.config.data_config import DataConfig
from dopepp.experiment.config.run_config import Protocols
from dopepp.experiment.results import conditions, display
from dopepp.experiment.results.breakdown import record_breakdown
from dopepp.experiment.results.compare import compare_reports
from dopepp.experiment.results.false_alarms import KEY, TITLE, count_false_alarms
from dopepp.experiment.results.folder import METRICS_FILE, write_json
from dopepp.experiment.results.frame import coverage_curve, reported_rates
from dopepp.experiment.results.measurement import (
    EstimatorMethod,
    FileMethod,
    ImageId,
    Measured,
    Method,
    ScoredPose,
    ViewsMethod,
    measure,
    object_numbers,
)
from dopepp.experiment.results.report import Report
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.refinement.refiner import Refine, refine_terms
from dopepp.metrics.pose import PoseMetrics
from dopepp.parts.part import Parts
from dopepp.recovery.reasons import summary


def measure_and_record(
    estimators: Mapping[str, PoseEstimator],
    parts: Parts,
    data: DataConfig,
    run_dir: Path,
    num_shown: int,
    details: Mapping[str, Any] | None = None,
    *,
    results: Mapping[str, Path] | None = None,
    bop_csv: bool = False,
    all_measures: bool = False,
    protocols: Protocols | None = None,
    refine: Refine | None = None,
    without_parts: SampleSource | None = None,
) -> tuple[Report, list[Report]]:
    """Measure methods on a test set; print and write tables, curves and images.

    ``metrics.json`` describes the last estimator, with its refined poses under ``refined``, or the
    file of poses if there is no estimator. ``details`` are further values of this file.

    The ``estimators`` are sorted, the baseline first, and measured with ``refine`` in addition.
    ``results`` are BOP challenge CSVs of other methods. Detections on ``without_parts``, images
    without the parts, are counted.

    Returns:
        The report in ``metrics.json``, and the reports of the estimators, the files, and the
        estimators on several views.
    """
    protocols = protocols or Protocols()
    source: SampleSource = held_out_source(data, parts, "test")
    numbers = object_numbers(data, parts)
    files = {name: FileMethod(path, parts, numbers) for name, path in (results or {}).items()}
    detectors = _estimator_methods(estimators, refine, parts)
    views = _views_methods(detectors, data.views, parts)
    methods: dict[str, Method] = {**detectors, **files}
    # Impossible protocols are rejected before anything is measured.
    if protocols.shading:
        conditions.check_masks(source)
    scaled = {scale: scaled_test_renders(data, parts, scale) for scale in protocols.scales}
    if views:
        source = with_views(source, data.views)
    samples = (source.sample(index, 0) for index in range(len(source)))
    is_bop = data.root is not None and data.format in ("bop", "webdataset")
    both = {**methods, **views}
    measured = measure(both, samples, num_shown, bop=is_bop and not data.is_rendered("test"))
    for file in files.values():
        file.check_used()
    for report in measured.reports:
        display.show_report(report, all_measures)
        if report.name in measured.bop:
            display.console.print(f"{report.name}: {measured.bop[report.name].in_words()}")
    _show_rejections(both, measured.silent, source)
    _record_coverage(run_dir, measured)
    if without_parts is not None:
        _record_false_alarms(run_dir, detectors, measured.reports, without_parts)
    main = _main_report(measured, list(detectors or files), refine is not None and bool(detectors))
    main.details.update(details or {})
    write_json(run_dir / METRICS_FILE, main.to_record())
    if bop_csv:
        _write_results(run_dir, measured.poses, data, numbers)
    _draw(run_dir, measured, len(source))
    if len(measured.reports) > 1:
        compare_reports(measured.reports, run_dir)
    rates = reported_rates(data, parts)
    for quantity in protocols.by:
        record_breakdown(run_dir, measured.metrics, quantity, protocols.num_bins, rates)
    if protocols.shading:
        shaded = conditions.measure_shading(
            methods, source, protocols.shading, data.eval_seed, measured.reports, num_shown
        )
        conditions.record_condition(run_dir, conditions.SHADING, *shaded, rates)
    if scaled:
        levels = conditions.measure_scales(methods, scaled, measured, num_shown)
        conditions.record_condition(run_dir, conditions.SCALE, *levels, rates)
    display.show_files(run_dir)
    return main, measured.reports


def _estimator_methods(
    estimators: Mapping[str, PoseEstimator], refine: Refine | None, parts: Parts
) -> dict[str, EstimatorMethod]:
    """Return a method per estimator and, with ``refine``, another with refined poses after it."""
    methods = {}
    for name, estimator in estimators.items():
        methods[name] = EstimatorMethod(estimator, parts)
        if refine is not None and isinstance(estimator, NetworkEstimator):
            refined = " + ".join([name, *refine_terms(refine)])
            methods[refined] = EstimatorMethod(refining(estimator, refine, parts), parts)
    return methods


def _views_methods(
    methods: Mapping[str, EstimatorMethod], num_views: int, parts: Parts
) -> dict[str, ViewsMethod]:
    """Return a method on several views per estimator with a refinement that verifies poses."""
    return {
        f"{name}, {num_views} views": ViewsMethod(method.estimator, parts)
        for name, method in methods.items()
        if num_views > 1
        and method.estimator.refiner is not None
        and method.estimator.refiner.verifies
    }


def _main_report(measured: Measured, names: Sequence[str], refines: bool) -> Report:
    """Return the report of the last of the methods ``names``, a result on single images.

    Later comparisons use the unrefined result of a network. If the last method ``refines`` the
    poses of the method before, its report is attached to the returned report.
    """
    reports = {report.name: report for report in measured.reports}
    if not refines:
        return reports[names[-1]]
    main, refined = (reports[name] for name in names[-2:])
    main.refined = refined
    shares = made_worse(measured.metrics[main.name], measured.metrics[refined.name])
    main.details["made_worse"] = shares
    in_words = ", ".join(f"{share:.1%} in {error}" for error, share in shares.items())
    display.console.print(f"poses that refinement made worse by over 1 mm: {in_words}")
    return main


def refining(estimator: NetworkEstimator, refine: Refine | None, parts: Parts) -> NetworkEstimator:
    """Return a copy of an estimator that refines its poses; without ``refine``, the estimator."""
    if refine is None:
        return estimator
    by_name = {part.name: part for part in parts}
    own_parts = [
        part if part.mesh is not None else by_name.get(part.name, part) for part in estimator.parts
    ]
    return estimator.refining(refine, own_parts)


def made_worse(network: PoseMetrics, refined: PoseMetrics) -> dict[str, float]:
    """Return the shares of refined poses whose ADD or translation error grew by more than 1 mm.

    Parts that are missing after refinement are ignored; the recall includes them.
    """
    shares = {}
    for error in ("add", "translation"):
        before, after = (
            np.concatenate([method.errors(name, error) for name in refined.parts])
            for method in (network, refined)
        )
        is_worse = (after > before + 0.001)[np.isfinite(after)]
        shares[error] = float(is_worse.mean()) if len(is_worse) else 0.0
    return shares


def _record_coverage(run_dir: Path, measured: Measured) -> None:
    """Draw observed over nominal coverage of the pose covariances, and add it to the reports."""
    curves: dict[str, RateCurve] = {}
    for report in measured.reports:
        metrics = measured.metrics[report.name]
        by_part = {name: coverage_curve(metrics.instances(name)) for name in metrics.parts}
        stated = {name: curve for name, curve in by_part.items() if curve is not None}
        curves |= {f"{report.name} {name}": curve for name, curve in stated.items()}
        report.details["coverage_curve"] = {
            name: {"nominal": curve.x.round(2).tolist(), "observed": curve.rate.tolist()}
            for name, curve in stated.items()
        }
    if curves:
        write_png(run_dir / "coverage.png", figure_image(coverage_figure(curves)))


def _record_false_alarms(
    run_dir: Path,
    methods: Mapping[str, EstimatorMethod],
    reports: Sequence[Report],
    frames: SampleSource,
) -> None:
    """Measure estimators on images without their parts, and add the counts to their reports."""
    estimators = {name: method.estimator for name, method in methods.items()}
    alarms, tiles = count_false_alarms(estimators, frames)
    for report in reports:
        if report.name in alarms:
            report.details[KEY] = asdict(alarms[report.name])
    display.show_table(TITLE, [alarm.row(name) for name, alarm in alarms.items()])
    if tiles:
        write_png(run_dir / "without_part.png", contact_sheet(tiles, columns=3))


def _draw(run_dir: Path, measured: Measured, num_images: int) -> None:
    """Draw the accuracy curves of every method and object, and the poses of the first images."""
    reports = measured.reports
    curves = {
        f"{report.name} {name}" if len(reports) > 1 else name: errors
        for report in reports
        for name, errors in report.errors.items()
    }
    save_accuracy_curves(run_dir / "auc", curves, title=f"{num_images} test images")
    if measured.tiles:
        write_png(run_dir / "overlay.png", contact_sheet(measured.tiles))


def _show_rejections(
    methods: Mapping[str, Method], silent: Mapping[str, Sequence[int]], source: SampleSource
) -> None:
    """Print, by estimator, the number of images without a detection (``silent``), and why."""
    for name, numbers in silent.items():
        method = methods[name]
        if not numbers or not isinstance(method, EstimatorMethod):
            continue
        if isinstance(method.estimator, NetworkEstimator):
            reasons = [method.rejection(source.sample(number, 0)) for number in numbers]
            line = summary([reason for reason in reasons if reason is not None], len(source))
            display.console.print(f"{name}: {line}")


def _write_results(
    run_dir: Path,
    poses: Mapping[str, Sequence[tuple[ImageId, ScoredPose, float | None]]],
    data: DataConfig,
    numbers: Mapping[str, int],
) -> None:
    dataset, split = data.name, "test"
    if data.root is not None and not data.is_rendered("test"):
        dataset, split = data.root.resolve().name, data.image_set("test")
    for method, measured in poses.items():
        rows = []
        for image, pose, seconds in measured:
            time = UNKNOWN_TIME if seconds is None else seconds
            number = numbers[pose.object]
            rows.append(BopResult(*image, number, pose.score, pose.T_cam_obj, time))
        write_results(run_dir / results_name(method, dataset, split), rows)
