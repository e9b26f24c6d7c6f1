"""Export a checkpoint to a runtime, and compare the export with the checkpoint before writing."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from dopepp.core.errors import RunError, UserError
from dopepp.core.files import draft
from dopepp.data.sample import SampleSource
from dopepp.experiment.assembly.renders import validation_renders
from dopepp.experiment.config.data_config import stored_config
from dopepp.experiment.program import entry_command
from dopepp.experiment.results.measurement import EstimatorMethod, measure
from dopepp.inference import runtimes
from dopepp.inference.benchmark import ExportAgreement, compare_export
from dopepp.inference.estimator import PoseEstimator
from dopepp.inference.export import EXPORTERS, PRECISIONS, check_possible
from dopepp.inference.runtimes import Export, Pixels
from dopepp.models.checkpoint import FOLDER, Checkpoint, load_network
from dopepp.models.network import network_cost

_log = logging.getLogger(__name__)

NUM_CHECKED: Final = 20  # rendered images on which the export is compared with PyTorch
NUM_IMAGES: Final = 100  # scenes to calibrate on, and further scenes to measure on


class ExportResult(NamedTuple):
    """A written export."""

    path: Path
    export: Export
    agreement: ExportAgreement  # with the checkpoint
    commands: tuple[str, str]  # to predict and to evaluate


def export(
    path: Path,
    layout: str = "onnx",
    precision: str = "fp32",
    out: Path | None = None,
    num_images: int = NUM_IMAGES,
) -> ExportResult:
    """Write the network of a checkpoint as one file (OpenVINO: a folder).

    The arguments are those of ``dopepp export``. A released checkpoint is exported to the working
    directory by default.

    Raises:
        RunError: An fp32 export differs from the checkpoint by more than rounding, another export
            has non-finite maps, or the file cannot be written. Nothing was written.
    """
    target = _output_path(path, layout, precision, out)
    if runtimes.is_export(path):
        fix = "pass the original checkpoint"
        raise UserError(f"{path}, which is an export", "a checkpoint", fix)
    check_possible(layout, precision)
    network, checkpoint = load_network(path)
    cost = network_cost(network, checkpoint.input_size)
    source = validation_renders(checkpoint, path, 2 * num_images)
    original = PoseEstimator.load(path)
    images: list[Pixels] = []
    if precision == "int8":
        _log.info("rendering %d validation scenes to calibrate on", num_images)
        for index in range(num_images, 2 * num_images):
            sample = source.sample(index)
            for view in original.views(sample.image, sample.K):
                images.append(np.ascontiguousarray(view.pixels.transpose(2, 0, 1)[None]))
    save = EXPORTERS[layout][0](network, precision, images)
    described = Export(layout, precision, network.size_multiple, *cost)
    with _draft_output(target) as draft_path:
        save(draft_path, checkpoint, described)
        if precision == "int8":
            described = replace(
                described,
                num_images=num_images,
                add_01d=_accuracy(original, PoseEstimator.load(draft_path), source, num_images),
            )
            save(draft_path, checkpoint, described)
        checked = [(sample.image, sample.K) for sample in map(source.sample, range(NUM_CHECKED))]
        agreement = compare_export(PoseEstimator.load(draft_path), original, checked)
        if not (agreement.is_exact if precision == "fp32" else np.isfinite(agreement.maps)):
            raise RunError(f"{target} was not written: it differs from {path}: {agreement}")
    return ExportResult(target, described, agreement, _commands(target, checkpoint))


@contextmanager
def _draft_output(target: Path) -> Iterator[Path]:
    """Yield a temporary path, moved to ``target`` on success; RunError if writing fails."""
    try:
        with draft(target) as draft_path:
            yield draft_path
    except OSError as error:
        fix = "free space there, or pass a path on another disk with --out"
        raise RunError(f"cannot write {target}: {error.strerror}; {fix}") from error


def _output_path(path: Path, layout: str, precision: str, out: Path | None) -> Path:
    """Check the options and return the path of the export."""
    choices = {"format": (layout, EXPORTERS), "precision": (precision, PRECISIONS)}
    for name, (value, allowed) in choices.items():
        if value not in allowed:
            fix = f"pass --{name} with one of these names"
            raise UserError(f"--{name} {value}", ", ".join(allowed), fix)
    ending = EXPORTERS[layout][1]
    if out is None:
        folder = Path() if path.parent == Path(FOLDER) and not path.exists() else path.parent
        short = "" if precision == "fp32" else f"_{precision}"
        out = folder / f"{path.stem}{short}{ending}"
    is_file = ending.startswith(".")
    if (is_file and out.suffix != ending) or (not is_file and out.suffix in (".xml", ".onnx")):
        allowed = f"a file NAME{ending}" if is_file else "a folder"
        fix = f"pass e.g. --out {path.stem}{ending}"
        raise UserError(f"--out {out} for --format {layout}", allowed, fix)
    others = [path for path in out.glob("*") if path.suffix not in (".xml", ".bin")]
    if (is_file and out.is_dir()) or (not is_file and out.is_file()) or others:
        problem = f"--out {out}, which exists and is not an export"
        raise UserError(problem, "a new path, or an earlier export", "pass a new path with --out")
    if out.exists() and path.exists() and out.samefile(path):
        fix = "pass another path with --out"
        raise UserError(f"--out {out}, which is the checkpoint", "the path of another file", fix)
    return out


def _accuracy(
    original: PoseEstimator, exported: PoseEstimator, source: SampleSource, count: int
) -> dict[str, float]:
    """Return ADD-0.1d of checkpoint (``fp32``) and export (``int8``) on ``count`` scenes."""
    _log.info("measuring both on %d other validation scenes", count)
    estimators = {"fp32": original, "int8": exported}
    methods = {
        name: EstimatorMethod(estimator, estimator.parts) for name, estimator in estimators.items()
    }
    measured = measure(methods, (source.sample(index) for index in range(count)), 0)
    return {report.name: report.mean.add_01d or 0.0 for report in measured.reports}


def _commands(path: Path, checkpoint: Checkpoint) -> tuple[str, str]:
    """Return the commands that predict with an export and evaluate the export."""
    config = stored_config(checkpoint.data) or {}
    words = [f"ckpt_path={path}"]
    if config.get("root"):  # an export contains no folders of this machine
        words.append(f"data.root={config['root']}")
    parts = [str(part) for part in config.get("parts") or ()]
    if not config.get("root") and any(Path(part).suffix for part in parts):
        words.append(f"data.parts=[{','.join(parts)}]")
    predict = f"dopepp predict {shlex.quote(str(path))} IMAGE --K FX FY CX CY"
    return predict, " ".join([entry_command("evaluate"), *map(shlex.quote, words)])
