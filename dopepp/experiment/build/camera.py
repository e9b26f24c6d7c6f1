"""A run in the user's own camera: what the network is to see of its pictures."""

from __future__ import annotations

import logging
from dataclasses import replace

from dopepp.core.errors import UserError
from dopepp.experiment.config.run import RunConfig
from dopepp.parts.part import Parts

_log = logging.getLogger(__name__)


def fitted_to_camera(config: RunConfig, parts: Parts) -> RunConfig:
    """Choose, where a camera is given, scale and input size by how large the parts appear in it.

    What was chosen stands in the config as if it had been given, and the log says it. A
    :class:`UserError`: the parts are larger than the picture or too small in it, or a given input
    size has no room for them.
    """
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
