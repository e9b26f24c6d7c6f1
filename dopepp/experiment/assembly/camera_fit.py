"""Choose the scale of the camera's images and the input size by the apparent size of the parts."""

from __future__ import annotations

import logging
from dataclasses import replace

from dopepp.core.errors import UserError
from dopepp.data.formats.bop.bop_reader import BopReader
from dopepp.experiment.assembly.build_sources import labelled_images
from dopepp.experiment.config.data_config import LensConfig
from dopepp.experiment.config.run_config import RunConfig
from dopepp.parts.part import Parts

_log = logging.getLogger(__name__)


def fit_to_camera(config: RunConfig, parts: Parts) -> RunConfig:
    """Return a config with camera scale and input size chosen by the apparent size of the parts.

    Without ``virtual.camera``, renders for a BOP data set use the camera of its test images. With
    neither camera, the config is returned unchanged. The chosen values are logged.
    """
    config = _with_camera_of_images(config, parts)
    data, virtual = config.data, config.data.virtual
    virtual.check_view()
    if (view := virtual.view) is None:
        return config
    scale = virtual.camera_scale or view.scale_for(parts, data.input_size)
    view.check(parts, scale)
    size = data.input_size or view.window_for(parts, scale)
    largest = view.sizes_px(parts, scale)[1]
    if largest > min(size):
        raise UserError(
            f"data.input_size={list(size)} for parts {largest:.0f} pixels across",
            f"width and height of at least {largest:.0f} pixels",
            "set data.input_size=null, or a smaller virtual.camera_scale",
        )
    for line in view.in_words(parts, scale, size):
        _log.info("%s", line)
    plain = {
        **config.plain,
        "data": {**config.plain["data"], "input_size": list(size)},
        "virtual": {**config.plain["virtual"], "camera_scale": scale},
    }
    fitted = replace(data, input_size=size, virtual=replace(virtual, camera_scale=scale))
    return replace(config, plain=plain, data=fitted)


def _with_camera_of_images(config: RunConfig, parts: Parts) -> RunConfig:
    """Set the camera and distances of the BOP test images for renders without a camera."""
    data, virtual = config.data, config.data.virtual
    rendered = data.real_fraction == 0 or (data.real_fraction < 1 and data.input_size is None)
    labelled = data.format == "bop" and not data.is_rendered("test")
    if virtual.camera is not None or not (rendered and labelled):
        return config
    source = labelled_images(data, parts, data.eval_seed, "test")
    assert isinstance(source, BopReader)
    size, K, annotated = source.view()
    distance = virtual.working_distance or annotated
    if distance is None:
        raise UserError(
            f"no annotated object in {source.name}, so the working distance is unknown",
            "working_distance=[near,far], metres",
            "add the distances at which the camera sees the parts, e.g. working_distance=[0.3,0.8]",
        )
    if virtual.working_distance is None:
        _log.info(
            "%s: rendering with the data set's camera and its annotated distances, %g – %g m; "
            "set camera=FILE and working_distance=[near,far] to change this",
            source.name,
            *distance,
        )
    lens = LensConfig.of(size, K)
    chosen = replace(virtual, camera=lens, working_distance=distance)
    changed = {"camera": vars(lens), "working_distance": list(distance)}
    plain = {**config.plain, "virtual": {**config.plain["virtual"], **changed}}
    return replace(config, plain=plain, data=replace(data, virtual=chosen))
