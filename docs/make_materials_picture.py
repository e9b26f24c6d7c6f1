"""Draw heaps of four materials by both renderers, ``docs/images/materials.jpg``.

python docs/make_materials_picture.py    # needs the extras robot and photoreal
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import yaml

from dopepp.core.files import write_image
from dopepp.drawing.sheet import Tile, contact_sheet
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import Factory
from dopepp.virtual.presets import preset_of

DOCS: Final = Path(__file__).parent
SIZE: Final = (400, 300)
IMAGE: Final = 3  # number of the heap
KINDS: Final = {
    "plastic": ("plastic", {}),
    "print": ("print", {}),
    "metal": ("metal", {"metal_share": 1.0, "brushed_share": 0.0}),
    "brushed metal": ("metal", {"metal_share": 1.0, "brushed_share": 1.0}),
}
"""The group ``materials`` of each column, and changes to it."""


def tile(name: str, renderer: str) -> Tile:
    """Return a heap of a material with a caption."""
    group, changes = KINDS[name]
    config = yaml.safe_load((DOCS.parent / f"conf/materials/{group}.yaml").read_text("utf-8"))
    scene = config["virtual"]["scene"]
    scene["materials"] |= {"alike_share": 1.0, **changes}
    preset = preset_of("heap", scene).resized(*SIZE)
    factory = Factory([pivconnector()], preset, seed=0, renderer=renderer)
    return Tile(factory.render(0, IMAGE).image, f"{name}, {renderer}")


def main() -> None:
    """Render the eight images and write them as one file."""
    tiles = [tile(name, renderer) for renderer in ("raster", "photoreal") for name in KINDS]
    write_image(DOCS / "images/materials.jpg", contact_sheet(tiles, len(KINDS), SIZE[0]))


if __name__ == "__main__":
    main()
