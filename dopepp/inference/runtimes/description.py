"""What an exported file says of itself: the checkpoint's description, and how it was exported.

It is one JSON text in the file's own metadata, under ``dopepp``, so a renamed file loads the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from dopepp.core.checks import check_integer, check_number
from dopepp.core.errors import UserError
from dopepp.core.json import parse_json
from dopepp.models.checkpoint import KEY, Checkpoint, packed, parse_description
from dopepp.models.network import check_spec
from dopepp.models.storage import MAX_HEADER_BYTES

_SECTION: Final = "export"
_MOST: Final = 1e12


@dataclass(frozen=True)
class Export:
    """How a network was exported.

    Attributes:
        format: ``onnx``, ``openvino`` or ``safetensors``.
        precision: ``fp32``, ``fp16`` (weights) or ``int8``.
        size_multiple: Image height and width must be multiples of this.
        parameters: Trained numbers of the network.
        gmacs: 10⁹ multiply-accumulates for one image of the training's size.
        add_01d: Share of instances with ADD below a tenth of the diameter on validation scenes, by
            precision; where it was quantised, before and after.
        num_images: How many scenes that were.
    """

    format: str
    precision: str
    size_multiple: int
    parameters: int
    gmacs: float
    add_01d: Mapping[str, float] = field(default_factory=dict)
    num_images: int = 0


def pack(checkpoint: Checkpoint, export: Export) -> str:
    """Return the text for a file's metadata."""
    return packed(described(checkpoint, export)[KEY])


def described(checkpoint: Checkpoint, export: Export) -> dict[str, Any]:
    """Return a checkpoint's content (:meth:`Checkpoint.to_file`) with how it was exported."""
    content = checkpoint.to_file()
    content[KEY][_SECTION] = asdict(export)
    return content


def unpack(text: str | None, path: Path) -> tuple[Checkpoint, Export]:
    """Read a file's text, which anybody may have written; None is a file without one.

    A :class:`UserError`: it is missing, damaged, too long, of a newer version, or names what may
    not be built. Nothing is built.
    """
    if text is None or len(text) > MAX_HEADER_BYTES:
        got = "no description" if text is None else f"a description of {len(text)} characters"
        allowed = f"one of at most {MAX_HEADER_BYTES} under {KEY!r}, as `dopepp export` writes it"
        raise UserError(f"{path}: {got}", allowed, "export the checkpoint again")
    payload = parse_json(text, f"{path}, description under {KEY!r}")
    try:
        checkpoint = parse_description(payload)
        check_spec(checkpoint.spec)
        export = _parse(payload.get(_SECTION))  # type: ignore[attr-defined]
        check_integer("stride", checkpoint.stride, 1, 256)
        if export.size_multiple % checkpoint.stride or not checkpoint.parts:
            got = f"size_multiple {export.size_multiple} and {len(checkpoint.parts)} parts"
            allowed = f"a multiple of the stride {checkpoint.stride}, and a part at least"
            raise UserError(got, allowed, "export the checkpoint again")
    except UserError as error:
        raise UserError(f"{error.got}, in {path}", error.allowed, error.fix) from error
    return checkpoint, export


def _parse(section: object) -> Export:
    """Read how a file was exported; a :class:`UserError` says which field is wrong."""
    known = Export.__dataclass_fields__
    if not isinstance(section, dict) or not section.keys() <= known.keys():
        got = f"{_SECTION} {section!r:.100}"
        raise UserError(got, ", ".join(known), "export the checkpoint again")
    rates = section.get("add_01d")
    rates = rates if isinstance(rates, dict) else {}
    return Export(
        format=str(section.get("format"))[:20],
        precision=str(section.get("precision"))[:20],
        size_multiple=check_integer("size_multiple", section.get("size_multiple"), 1, 1024),
        parameters=check_integer("parameters", section.get("parameters"), 0, int(_MOST)),
        gmacs=check_number("gmacs", section.get("gmacs"), 0, _MOST),
        add_01d={str(key)[:20]: check_number(key, rate, 0, 1) for key, rate in rates.items()},
        num_images=check_integer("num_images", section.get("num_images", 0), 0, int(_MOST)),
    )
