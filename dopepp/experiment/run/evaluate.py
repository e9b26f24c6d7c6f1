"""Run ``evaluate.py``: measure checkpoints and files of poses, or tune a checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import torch

from dopepp.core import extensions
from dopepp.core.errors import UserError
from dopepp.experiment import program
from dopepp.experiment.assembly.build_parts import build_parts
from dopepp.experiment.assembly.build_sources import note_on_shared_folder
from dopepp.experiment.config.data_config import DataConfig, evaluation_data, stored_config
from dopepp.experiment.config.run_config import EvaluationConfig, FalsePositiveTarget
from dopepp.experiment.results import display
from dopepp.experiment.results.false_alarms import frames_without_parts
from dopepp.experiment.results.folder import write_config, write_environment, write_json
from dopepp.experiment.results.pages import write_run_readme
from dopepp.experiment.results.recording import measure_and_record, refining
from dopepp.experiment.results.report import Report
from dopepp.experiment.run.tuning import Tuning, tune, write_tuned
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.network_estimator import NetworkEstimator
from dopepp.inference.runtimes import is_export
from dopepp.inference.template_estimator import TemplateEstimator
from dopepp.models.network import PoseNetwork
from dopepp.parts.part import Part, Parts

TEMPLATES: Final = "templates"
"""Name of the method that matches templates of the meshes, without training."""

_log = logging.getLogger(__name__)


def tune_and_record(
    estimator: NetworkEstimator,
    path: Path,
    parts: Parts,
    data: DataConfig,
    run_dir: Path,
    target: FalsePositiveTarget,
) -> Path:
    """Tune score, thresholds and factors of the checkpoint at ``path``; return the new path."""
    if target.false_positive_rate == 1:
        fix = "set e.g. 0.005 to suppress detections on images without the part"
        _log.warning("false_positive_rate=1: every candidate is reported; %s", fix)
    tuning = tune(estimator, data, parts, target)
    tuned = write_tuned(estimator.checkpoint, path, tuning.options)
    write_json(run_dir / "tuning.json", asdict(tuning))
    _show(tuning, tuned)
    return tuned


def _show(tuning: Tuning, path: Path) -> None:
    shown, empty = tuning.num_images
    rows = [
        {
            "": f"{name.replace('_', ' ')} %",
            "network before": f"{100 * before:.1f}",
            "after": f"{100 * getattr(tuning.after, name):.1f}",
        }
        for name, before in vars(tuning.before).items()
    ]
    display.show_table(f"tuned; measured on {shown} test images and {empty} without objects", rows)
    for name, value in tuning.options.items():
        display.console.print(f"recovery.{name}: {value:.4g}")
    if tuning.kept:
        display.console.print(f"old factors kept: {tuning.kept}")
    display.console.print(f"tuned checkpoint {path}")


def parts_of(estimators: Sequence[PoseEstimator], data: DataConfig) -> list[Part]:
    """Return the test data's parts that the last estimator detects; all without an estimator.

    Unless ``data.symmetries`` is set, parts for which the test data states no symmetries have those
    of the checkpoint.

    Raises:
        UserError: The data lacks a part, or another estimator detects none of the parts.
    """
    if not estimators:
        return build_parts(data)
    trained = estimators[-1].parts
    names = [part.name for part in trained]
    if data.root is not None and data.objects is None:
        data = replace(data, objects=tuple(names))
    for estimator in estimators:
        if not {part.name for part in estimator.parts} & set(names):
            others = ", ".join(part.name for part in estimator.parts)
            fix = "leave out the baseline, or choose a checkpoint of one of these objects"
            raise UserError(f"a baseline of {others}", f"one or more of {', '.join(names)}", fix)
    available = {part.name: part for part in build_parts(data)}
    missing = [name for name in names if name not in available]
    if missing:
        raise UserError(
            f"test data without {', '.join(missing)}, which the checkpoint was trained on",
            ", ".join(names),
            "set data.root or data.parts to data of these objects",
        )
    parts = []
    for stored in trained:
        part = available[stored.name]
        if stored.mesh_hash and part.mesh_hash and not part.has_shape_of(stored):
            _log.warning("the checkpoint was trained on another shape of %s", part.name)
        if data.symmetries is None and not part.has_symmetries:
            discrete, continuous = stored.symmetries_discrete, stored.symmetries_continuous
            part = replace(part, symmetries_discrete=discrete, symmetries_continuous=continuous)
        parts.append(part)
    return parts


def run_evaluation(config: Mapping[str, Any], run_dir: Path) -> list[Report]:
    """Measure estimators and files of poses; return a report per method, none after tuning."""
    program.quiet_lightning()
    options = EvaluationConfig.of(config)
    extensions.enable(options.extensions)
    _check_combination(options)
    loaded = _load(options)
    checkpoint = loaded[-1].checkpoint if loaded else None
    measured = str(options.ckpt_path or options.baseline or options.results or TEMPLATES)
    stored = None if checkpoint is None else stored_config(checkpoint.data)
    data = evaluation_data(options.data, options.virtual, stored, measured)
    refines = "region" in (options.refine or ()) or options.templates is not None
    if data.views > 1 and not refines:
        problem, fix = f"data.views={data.views} without refine=region", "add refine=region"
        raise UserError(problem, "both options, or templates=[near,far]", fix)
    write_config(run_dir, options.plain)
    fingerprint = "" if checkpoint is None else checkpoint.data_fingerprint
    write_environment(run_dir, data.eval_seed, fingerprint)
    parts = parts_of(loaded, data)
    share = note_on_shared_folder(data)
    if share is not None:
        display.console.print(share)
    if options.tune:
        if not isinstance(loaded[0].network, PoseNetwork):
            fix = "tune the checkpoint, then export the tuned checkpoint"
            raise UserError(f"tune=true of {measured}, which is an export", "a checkpoint", fix)
        estimator = refining(loaded[0], options.refine, parts)
        tune_and_record(estimator, Path(measured), parts, data, run_dir, options)
        display.show_files(run_dir)
        return []
    estimators, files = _methods(options, loaded, parts)
    without_parts = None
    if options.negatives is not None:
        camera = None if options.negatives_camera is None else Path(options.negatives_camera)
        without_parts = frames_without_parts(Path(options.negatives), camera, data, parts)
    main, reports = measure_and_record(
        estimators,
        parts,
        data,
        run_dir,
        options.num_pictures,
        results=files,
        bop_csv=options.bop_csv,
        all_measures=options.all_measures,
        protocols=options.protocols,
        refine=options.refine,
        without_parts=without_parts,
    )
    write_run_readme(run_dir, f"Evaluation of {measured}", main)
    return reports


def _load(options: EvaluationConfig) -> list[NetworkEstimator]:
    """Load the estimators of ``baseline`` and ``ckpt_path``, if set, in this order."""
    paths = [path for path in (options.baseline, options.ckpt_path) if path is not None]
    device = options.device
    if device == "auto":
        exported = any(is_export(Path(path)) for path in paths)
        device = "cuda" if torch.cuda.is_available() and not exported else "cpu"
    return [PoseEstimator.load(path, device, scale_error=options.scale_error) for path in paths]


def _methods(
    options: EvaluationConfig, loaded: Sequence[NetworkEstimator], parts: Parts
) -> tuple[dict[str, PoseEstimator], dict[str, Path]]:
    """Return the estimators (networks, templates) and the files of poses to measure, by name."""
    estimators: list[PoseEstimator] = list(loaded)
    names = [str(estimator.checkpoint.data.get("name", "estimate")) for estimator in loaded]
    files: dict[str, Path] = {}
    if options.templates is not None:
        position = max(len(loaded) - 1, 0)  # metrics.json describes the last estimator
        names.insert(position, TEMPLATES)
        templates = TemplateEstimator.of_parts(
            parts, options.templates, scale_error=options.scale_error
        )
        estimators.insert(position, templates)
    if options.results is not None:  # BOP file names begin with the name of the method
        file = Path(options.results)
        names.append(file.stem.partition("_")[0] if options.method is None else str(options.method))
        files = {names[-1]: file}
    for number, name in enumerate(names[:-1]):
        if name in names[number + 1 :]:
            names[number] += " (baseline)" if number == 0 else " (checkpoint)"
    return dict(zip(names, estimators, strict=False)), files


def _check_combination(options: EvaluationConfig) -> None:
    has_network = options.ckpt_path is not None or options.baseline is not None
    templates, both = options.templates is not None, "both options together"
    protocols = options.protocols
    changes_images = bool(protocols.shading or protocols.scales)
    further = protocols or options.negatives is not None or templates
    combinations: list[tuple[bool, str, str, str]] = [
        (
            options.ckpt_path is None and options.results is None and not templates,
            "nothing to evaluate",
            "one or more of ckpt_path=…, results=… and templates=…",
            "add ckpt_path=FILE for a checkpoint, results=FILE for a file of poses, or "
            "templates=[0.3,0.5] for the meshes alone",
        ),
        (
            options.refine is not None and not has_network,
            f"refine={options.refine} without ckpt_path",
            "refine=… together with ckpt_path=… (poses from a file are not refined)",
            "leave out refine, or add ckpt_path",
        ),
        (
            options.scale_error is not None and options.refine is None and not templates,
            f"scale_error={options.scale_error} without refine",
            both,
            "add refine=region, or leave out scale_error",
        ),
        (
            options.negatives_camera is not None and options.negatives is None,
            f"negatives_camera={options.negatives_camera} without negatives",
            both,
            "add negatives=FOLDER, or leave out negatives_camera",
        ),
        (
            options.negatives is not None and not has_network and not templates,
            f"negatives={options.negatives} without ckpt_path",
            both,
            "add ckpt_path, or leave out negatives (a file has no poses on these images)",
        ),
        (
            options.results is not None and changes_images,
            f"shading or scale with results={options.results}, which has no poses on these images",
            "checkpoints (ckpt_path, baseline)",
            "leave out shading and scale, or results",
        ),
        (
            options.tune and bool(further),
            "tune=true with shading, scale, by, negatives or templates",
            "tune=true without these options",
            "tune first, then evaluate the tuned checkpoint with these options",
        ),
        (
            options.tune and (options.ckpt_path is None or options.baseline is not None),
            "tune=true with a baseline or without ckpt_path",
            "one ckpt_path, and no baseline",
            "add ckpt_path=FILE, and leave out baseline",
        ),
    ]
    for is_impossible, problem, allowed, fix in combinations:
        if is_impossible:
            raise UserError(problem, allowed, fix)
