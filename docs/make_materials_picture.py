"""Draw heaps of four materials by both renderers, ``docs/images/materials.jpg``.

python docs/make_materials_picture.py    # needs the extras robot and photoreal
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import yaml

from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory
from dopepp.virtual.presets import Preset

SIZE: Final = (400, 300)
IMAGE: Final = 3  # number of the heap
KINDS: Final = {
    "plastic": {"metal_share": 0.0, "print_share": 0.0},
    "print": {"metal_share": 0.0, "print_share": 1.0},
    "metal": {"metal_share": 1.0, "brushed_share": 0.0},
    "brushed metal": {"metal_share": 1.0, "brushed_share": 1.0},
}


def preset_of(options: dict[str, float]) -> Preset:
    """Return the preset ``heap`` with a material; metals mirror the panels of ``metal.yaml``."""
    metal = yaml.safe_load((Path(__file__).parents[1] / "conf/materials/metal.yaml").read_text())
    heap = PRESETS["heap"].resized(*SIZE)
    panels = tuple(metal["virtual"]["scene"]["lighting"]["num_panels"])
    lighting = replace(heap.lighting, num_panels=panels)
    materials = replace(heap.materials, alike_share=1.0, **options)
    return replace(heap, materials=materials, lighting=lighting)


def main() -> None:
    """Render the eight images and write them as one file."""
    rows = []
    for renderer in ("raster", "photoreal"):
        images = []
        for name, options in KINDS.items():
            factory = Factory([pivconnector()], preset_of(options), seed=0, renderer=renderer)
            image = np.ascontiguousarray(factory.render(0, IMAGE).image[..., ::-1])
            label = f"{name}, {renderer}"
            cv2.putText(image, label, (8, 20), 0, 0.55, (255, 255, 255), 1, cv2.LINE_AA)
            images.append(image)
        rows.append(np.hstack(images))
    path = Path(__file__).parent / "images/materials.jpg"
    cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
