"""The shading protocol (paper Table 3): pass rates as more of every object is covered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from dopepp.core.errors import UserError
from dopepp.data.sample import Instance, Sample, Source
from dopepp.data.transforms.shading import TOLERANCE, Shaded, shade
from dopepp.drawing.sheet import Tile
from dopepp.experiment.reports.condition import MAX_EXAMPLES, Condition, Level
from dopepp.experiment.reports.evaluators import ImageId, Method, image_id
from dopepp.experiment.reports.report import Report
from dopepp.metrics.pose import MIN_VISIBLE_FRACTION, PoseMetrics

_MARGIN: Final = 0.3
"""Around the objects on the sheet, as a share of their extent."""


SHADING: Final = Condition(
    name="shading",
    axis="share of the visible area covered (%)",
    level="share",
    form="{:g} %",
    introduction="""# Shading

Columns: the share of every object's visible pixels that patches of the image's own background
cover (paper Table 3). What counts is decided before the shading.""",
    images="images with patches",
    per_unit=100,
)


def check_masks(source: Source) -> None:
    """Make sure, before anything takes time, that there is something to shade.

    Images are read until one has an instance mask.

    Raises:
        UserError: None of them has.
    """
    for index in range(len(source)):
        if any(one.mask is not None and one.mask.any() for one in source.sample(index).instances):
            return
    raise UserError(
        f"shading on {source.name}, {len(source):,} images without an instance mask",
        "images with masks: renders, label images of YCB-Video, mask_visib of BOP",
        "choose such data, or leave out shading",
    )


def measure_shading(
    methods: Mapping[str, Method],
    source: Source,
    shares: Sequence[float],
    seed: int,
    unmasked: Sequence[Report],
    num_examples: int = MAX_EXAMPLES,
) -> tuple[list[Level], list[Tile]]:
    """Measure every method at every share.

    The ground truth is that of the image as it came: an instance counts by what is visible of it
    before the shading, or heavy shading would drop out of the measurement.

    Args:
        methods: By name.
        source: The test set.
        shares: Of the visible area of every instance, without 0.
        seed: Of the patches.
        unmasked: What was measured on the images as they are.
        num_examples: How many images are shown.

    Returns:
        What was measured at 0 and at every share, and the examples, image by image.
    """
    accumulators = [_Accumulator(methods, share) for share in shares]
    tiles: list[Tile] = []
    for index in range(len(source)):
        sample = source.sample(index)
        shaded = shade(sample, shares, seed, index)
        for accumulator, one in zip(accumulators, shaded, strict=True):
            accumulator.add(sample, one, image_id(sample, index))
        num_shown = len(tiles) // (len(shares) + 1)
        if num_shown < min(num_examples, MAX_EXAMPLES) and any(map(_counts, sample.instances)):
            tiles += _examples(sample, shaded)
    rows = {report.name: report.rows for report in unmasked}
    unshaded = Level(0.0, rows, {"share_reached": 0.0, "num_outside_tolerance": 0})
    return [unshaded, *(one.level() for one in accumulators)], tiles


class _Accumulator:
    """All methods at one share."""

    def __init__(self, methods: Mapping[str, Method], share: float) -> None:
        self._methods, self._share = methods, share
        self._metrics = {
            name: PoseMetrics(method.parts, name, sync_on_compute=False)
            for name, method in methods.items()
        }
        self._reached: list[float] = []

    def add(self, sample: Sample, shaded: Shaded, image: ImageId) -> None:
        """Find poses on the shaded image and score them by the truth of the one that came."""
        for one, reached in zip(sample.instances, shaded.reached, strict=True):
            if _counts(one):
                self._reached.append(np.nan if reached is None else reached)
        for name, method in self._methods.items():
            poses, _ = method.detect(shaded.sample, image)
            self._metrics[name].update(poses, sample.instances, sample.K, sample.size[0])

    def level(self) -> Level:
        """Sum up."""
        rows = {name: metrics.compute() for name, metrics in self._metrics.items()}
        # A share that is not known (NaN) is near no other.
        outside = [one for one in self._reached if not abs(one - self._share) <= TOLERANCE]
        known = [one for one in self._reached if np.isfinite(one)]
        facts = {
            "share_reached": float(np.mean(known)) if known else None,
            "num_outside_tolerance": len(outside),
        }
        note = (
            f"At {SHADING.heading(self._share)}, {len(outside)} of {len(self._reached)} instances "
            f"are not within {100 * TOLERANCE:g} points of it: no mask, or no background to cover "
            "them with."
        )
        return Level(self._share, rows, facts, note if outside else "")


def _counts(instance: Instance) -> bool:
    return instance.visible_fraction >= MIN_VISIBLE_FRACTION


def _examples(sample: Sample, shaded: Sequence[Shaded]) -> list[Tile]:
    """Return the objects as they came and at every share, captioned with the shares reached."""
    place = _around_masks(sample)
    tiles = [Tile(sample.image[place], f"{sample.key}: unmasked")]
    for one in shaded:
        known = [f"{100 * r:.1f}" for r in sorted(r for r in one.reached if r is not None)]
        covered = " … ".join(dict.fromkeys([*known[:1], *known[-1:]])) or "nothing"
        tiles.append(
            Tile(one.sample.image[place], f"{SHADING.heading(one.share)} (reached {covered})")
        )
    return tiles


def _around_masks(sample: Sample) -> tuple[slice, slice]:
    """Return the image's rows and columns around all masks, with a margin."""
    masks = [one.mask for one in sample.instances if one.mask is not None]
    slices = []
    for axis, size in ((1, sample.image.shape[0]), (0, sample.image.shape[1])):
        shown = np.any(masks, axis=0).any(axis=axis) if masks else np.ones(size, bool)
        hit = np.flatnonzero(shown) if np.any(shown) else np.arange(size)
        first, last = int(hit[0]), int(hit[-1])
        margin = round(_MARGIN * (last - first + 1))
        slices.append(slice(max(0, first - margin), last + 1 + margin))
    return slices[0], slices[1]
