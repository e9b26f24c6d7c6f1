"""A run in the user's own camera: what the network is to see of its pictures."""

from __future__ import annotations

import logging
from dataclasses import replace

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.reader import BopReader
from dopepp.experiment.assembly.sources import labelled_images
from dopepp.experiment.config.data import LensConfig
from dopepp.experiment.config.run import RunConfig
from dopepp.parts.part import Parts

_log = logging.getLogger(__name__)


def fitted_to_camera(config: RunConfig, parts: Parts) -> RunConfig:
    """Choose, where a camera is given, scale and input size by how large the parts appear in it.

    Renders of a BOP data set's models have the camera of its pictures where none is given. What was
    chosen stands in the config as if it had been given, and the log says it.
    """
    config = _with_camera_of_pictures(config, parts)
    data, virtual = config.data, config.data.virtual
    view = virtual.view
    if view is None:
        return config
    scale = virtual.camera_scale or view.scale_for(parts, data.input_size)
    view.check(parts, scale)
    size = data.input_size or view.window_for(parts, scale)
    largest = view.sizes_px(parts, scale)[1]
    if largest > min(size):
        raise UserError(
            f"data.input_size={list(size)} for parts of {largest:.0f} pixels across",
            "an input that is larger than the parts in it",
            "leave data.input_size=null, or set a smaller virtual.camera_scale",
        )
    for line in view.in_words(parts, scale, size):
        _log.info("%s", line)
    plain = {
        **config.plain,
        "data": {**config.plain["data"], "input_size": list(size)},
        "virtual": {**config.plain["virtual"], "camera_scale": scale},
    }
    seen = replace(data, input_size=size, virtual=replace(virtual, camera_scale=scale))
    return replace(config, plain=plain, data=seen)


def _with_camera_of_pictures(config: RunConfig, parts: Parts) -> RunConfig:
    """Return a config with the camera, and the distances, of the test's BOP pictures.

    Only where renders are learned, no camera is given, nor, with real images, an input size.
    """
    data, virtual = config.data, config.data.virtual
    rendered = data.real_fraction == 0 or (data.real_fraction < 1 and data.input_size is None)
    if (
        not rendered
        or data.format != "bop"
        or virtual.camera is not None
        or data.is_rendered("test")
    ):
        return config
    source = labelled_images(data, parts, data.eval_seed, "test")
    if not isinstance(source, BopReader):
        return config
    (width, height), K, annotated = source.view()
    distance = virtual.working_distance or annotated
    if distance is None:
        raise UserError(
            f"no annotated object in {source.name}, which would tell how far away they are",
            "working_distance=[near,far], metres",
            "state the distances at which the camera is to find the parts",
        )
    if virtual.working_distance is None:
        _log.info(
            "%s: renders are as its camera sees parts at %g – %g m, as they are annotated there; "
            "camera=FILE working_distance=[near,far] say it otherwise", source.name, *distance,
        )  # fmt: skip
    lens = LensConfig(
        width=width, height=height,
        fx=float(K[0, 0]), fy=float(K[1, 1]), cx=float(K[0, 2]), cy=float(K[1, 2]),
    )  # fmt: skip
    chosen = replace(virtual, camera=lens, working_distance=distance)
    plain = {
        **config.plain,
        "virtual": {
            **config.plain["virtual"],
            "camera": vars(lens),
            "working_distance": list(distance),
        },
    }
    return replace(config, plain=plain, data=replace(data, virtual=chosen))
