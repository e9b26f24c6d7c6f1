"""Define a render job from user input, record it, and claim its folder.

The record holds all settings that determine the bytes of the job's files, in JSON types. A job
claims a folder by writing its record there, and is rejected in a folder with another record.

To add a layout, write a :class:`~dopepp.data.formats.Writer` and one line in :data:`WRITERS`.
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import yaml

from dopepp.core.errors import NO_SPACE, StoppedError, UserError, check_choice, system_failure
from dopepp.core.files import PARTIAL_SUFFIX, is_abandoned, partial_path, write_file
from dopepp.core.json import read_json
from dopepp.core.validation import Pair, Range, check
from dopepp.data.formats import RECORD_FILE, Writer
from dopepp.data.formats.bop.bop_writer import BopWriter
from dopepp.data.formats.ndds.ndds_writer import NddsWriter
from dopepp.data.formats.webdataset.webdataset_writer import WebdatasetWriter
from dopepp.data.rendered import rendered_sample
from dopepp.data.sample import Sample
from dopepp.geometry.camera import invert_transform
from dopepp.parts.catalogue import load_part
from dopepp.parts.mesh.read import ASSUMED_UNIT
from dopepp.parts.part import Part, check_name
from dopepp.virtual.backgrounds import find_backgrounds
from dopepp.virtual.factory import Factory, code_hash
from dopepp.virtual.presets import Preset, preset_of
from dopepp.virtual.presets.view import View, read_lens

_log = logging.getLogger(__name__)

WRITERS: Final[dict[str, Callable[[Path, Sequence[Part]], Writer]]] = {
    "bop": BopWriter,
    "ndds": NddsWriter,
    "webdataset": WebdatasetWriter,
}

MAX_VIEWS: Final = 16
RECORD_VERSION: Final = 1  # version of the record's layout
_HASH_DIGITS: Final = 16  # digits of the rendering code's hash
_NAMED: Final = re.compile(r"([^=/\\]+)=(.+)")  # ``NAME=FILE``; a name is not a path


@dataclass(frozen=True)
class RenderJob:
    """Definition of the images to render, independent of processes and shards."""

    factory: Factory  # renders scene (epoch 0, index)
    layout: str
    views: int  # cameras of each scene
    record: Mapping[str, Any]  # settings in JSON types; equal records give equal files

    def writer(self, root: Path) -> Writer:
        """Return a writer in the job's layout to the data set in folder ``root``."""
        writer = WRITERS[self.layout](root, self.factory.parts)
        if self.views > 1:
            writer.chunk_size = self.views  # a folder for each static scene
        return writer

    def sample(self, index: int) -> Sample:
        """Render an image: view ``index % views`` of scene ``index // views``."""
        scene, view = divmod(index, self.views)
        rendered = self.factory.render(0, scene, view=view)
        sample = rendered_sample(rendered, "virtual", str(index))
        if self.views > 1:
            sample.T_world_cam = invert_transform(rendered.scene.T_cam_world)
        return sample


def make_job(
    parts: Sequence[str],
    *,
    unit: str | None = None,
    preset: str = "paper",
    changes: Sequence[str] = (),
    size: str | None = None,
    seed: int = 0,
    backgrounds: str | Path | None = None,
    negatives: Sequence[str] = (),
    renderer: str = "raster",
    layout: str = "bop",
    camera: str | Path | None = None,
    working_distance: Pair | None = None,
    views: int = 1,
) -> RenderJob:
    """Make a job from user input; the arguments are the options of ``dopepp render``.

    ``parts`` and ``negatives`` are built-in names, mesh files, or ``NAME=FILE`` to name a file's
    part. ``changes`` are fields of the preset as ``field.field=value``, the value in YAML. ``size``
    is ``WIDTHxHEIGHT`` in pixels, and ``layout`` a key of :data:`WRITERS`.
    """
    check_choice("--format", layout, WRITERS)
    check("--views", views, int, Range(1, MAX_VIEWS))
    if views > 1 and layout != "bop":
        problem = f"--views {views} with --format {layout}"
        raise UserError(problem, "--views only with --format bop", "leave out --format, or --views")
    scenes = preset_of(preset, _nested(changes))
    targets = [named_part(text, unit) for text in parts]
    if camera is not None or working_distance is not None:
        scenes = _in_camera(scenes, targets, camera, working_distance)
    if size is not None:
        sides = re.fullmatch(r"([0-9]{1,6})[x,]([0-9]{1,6})", size)
        if sides is None:
            raise UserError(f"--size {size}", "WIDTHxHEIGHT in pixels", "pass e.g. --size 640x480")
        scenes = scenes.reframed(int(sides[1]), int(sides[2]))
    factory = Factory(
        targets,
        scenes,
        seed,
        find_backgrounds(backgrounds),
        renderer=renderer,
        negatives=[named_part(text, unit) for text in negatives],
    )
    # The user's choices come first, as messages show the first differences.
    record = {
        "record_version": RECORD_VERSION,
        "format": layout,
        "seed": factory.seed,
        "renderer": factory.renderer,
        "unit": unit or ASSUMED_UNIT,
        "parts": [_part_record(part) for part in factory.parts],
        "negatives": [_part_record(part) for part in factory.negatives],
        "backgrounds": factory.backgrounds.identity(),
        "preset": asdict(factory.preset),
        "rendering_code": code_hash()[:_HASH_DIGITS],
    }
    # One view adds no key, so that older folders can be continued.
    if views > 1:
        record["views"] = views
    return RenderJob(factory, layout, views, record)


def named_part(text: str, unit: str | None) -> Part:
    """Load a built-in part by name, or a part from a mesh file, given as FILE or ``NAME=FILE``."""
    match = None if Path(text).exists() else _NAMED.fullmatch(text)
    if match is None:
        return load_part(text, unit)
    return replace(load_part(match[2], unit), name=check_name(match[1]))


def _in_camera(
    scenes: Preset, parts: Sequence[Part], path: str | Path | None, distance: Pair | None
) -> Preset:
    """Return the preset with a file's camera and distance (metres); log the parts' image sizes."""
    if path is None or distance is None:
        missing = "--camera FILE" if path is None else "--working-distance 0.3,0.8"
        given = "--working-distance" if path is None else "--camera"
        raise UserError(f"{given} without {missing}", "both options, or neither", f"add {missing}")
    view = View(*read_lens(path), distance, str(path))
    view.check(parts)
    for line in view.in_words(parts):
        _log.info("%s", line)
    return view.whole(scenes, view.scale_for(parts))


def _nested(changes: Sequence[str]) -> dict[str, Any]:
    """Convert ``a.b=1`` to ``{"a": {"b": 1}}``."""
    tree: dict[str, Any] = {}
    for change in changes:
        path, sign, text = change.partition("=")
        *groups, field = path.split(".")
        try:
            value = yaml.safe_load(text)
        except (yaml.YAMLError, ValueError, RecursionError) as error:
            sign, value = "", error
        if not sign or not all((*groups, field)):
            allowed = "FIELD.FIELD=VALUE, the value in YAML"
            fix = "write e.g. --set lighting.num_lights=[1,3]"
            raise UserError(f"--set {change:.200}", allowed, fix)
        node: Any = tree
        for group in groups:
            node = node.setdefault(group, {}) if isinstance(node, dict) else None
        if not isinstance(node, dict) or field in node:
            problem = f"--set {change} after another --set of {path}"
            raise UserError(problem, "one --set for each field", "remove the repeated --set")
        node[field] = value
    return tree


def _part_record(part: Part) -> dict[str, Any]:
    """Describe a part by its name, size and hashes of shape and appearance."""
    return {
        "name": part.name,
        "diameter": float(part.diameter),
        "mesh_hash": part.mesh_hash,
        "texture_hash": part.appearance_hash(),
    }


_MAX_RECORD_BYTES: Final = 4_000_000  # about 10,000 parts
_MAX_DIFFERENCES: Final = 3  # differences shown in an error message


def is_claimed(root: Path) -> bool:
    """Return whether the folder has the record of a job."""
    return (root / RECORD_FILE).is_file()


def claim(root: Path, record: Mapping[str, Any]) -> None:
    """Reserve a folder by a job's record, unless reserved, and remove files of interrupted writes.

    Raises:
        UserError: The folder is not writable, or holds another job or other files.
        StoppedError: The disk is full.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        _write_record(root, json.loads(json.dumps(record)))
        _remove_abandoned(root)
    except OSError as error:
        if error.errno in NO_SPACE:
            raise StoppedError(system_failure(error, root)) from error
        problem, fix = f"folder {root}: {error.strerror}", "pass another folder with --out"
        raise UserError(problem, "a folder that can be written", fix) from error


def _write_record(root: Path, record: Mapping[str, Any]) -> None:
    """Write a job's record to a new folder; raise a UserError if the folder has another record."""
    path = root / RECORD_FILE
    # Listed before the check for a record, because other shards write after their record.
    names = sorted(entry.name for entry in root.iterdir())
    if not path.exists():
        foreign = [name for name in names if not name.endswith(PARTIAL_SUFFIX)]
        if foreign:
            problem = f"folder {root}, which holds {foreign[0]!r} and no {RECORD_FILE}"
            allowed = "an empty folder, or the folder of a render job"
            raise UserError(problem, allowed, "pass a new folder with --out")
        write_file(path, (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
    # This also follows writing, as two jobs may begin simultaneously.
    differences = list(_differences(read_json(path, _MAX_RECORD_BYTES), record, ""))
    if differences:
        problem = f"{path} of another job: {', '.join(differences[:_MAX_DIFFERENCES])}"
        fix = "use the folder's settings and version of dopepp, or pass a new folder with --out"
        raise UserError(problem, "the settings of the folder's first job", fix)


def _differences(stored: object, current: object, where: str) -> Iterator[str]:
    """Yield a text for each field below ``where`` that differs, with its path and both values."""
    if isinstance(stored, dict) and isinstance(current, dict):
        for key in current | stored:
            field = f"{where}.{key}" if where else str(key)
            yield from _differences(stored.get(key), current.get(key), field)
    elif isinstance(stored, list) and isinstance(current, list) and len(stored) == len(current):
        for number, pair in enumerate(zip(stored, current, strict=True)):
            yield from _differences(*pair, f"{where}[{number}]")
    elif stored != current:
        texts = (json.dumps(value) for value in (stored, current))
        before, after = (text if len(text) <= 60 else f"{text[:57]}..." for text in texts)
        yield f"{where or 'content'} is {before} there and {after} now"


def _remove_abandoned(root: Path) -> None:
    """Remove the partial files of killed processes; keep those of shards still being rendered."""
    clock = partial_path(root / "clock")
    clock.touch()
    now = clock.stat().st_mtime
    clock.unlink()
    for folder, _, names in os.walk(root):
        for name in names:
            path = Path(folder, name)
            if name.endswith(PARTIAL_SUFFIX) and is_abandoned(path, now):
                path.unlink(missing_ok=True)
