"""Cut the photos that the package ships (dopepp/virtual/backgrounds/photos) from their sources.

    pip install scikit-image==0.26.0
    npm pack @wp-playground/wordpress-builds@0.9.19
    tar xzf wp-playground-wordpress-builds-0.9.19.tgz package/public/wp-nightly/wp-content/themes
    python benchmarks/cut_photos.py package/public/wp-nightly/wp-content/themes

Origins and licences are in the folder's NOTICE.md.
"""

import importlib.util
import sys
from pathlib import Path
from typing import Final

from PIL import Image, ImageOps

SIZE: Final = (640, 480)
QUALITY: Final = 80
FOLDER: Final = Path(__file__).parents[1] / "dopepp/virtual/backgrounds/photos"

SKIMAGE: Final = (
    "astronaut.png", "brick.png", "camera.png", "chelsea.png", "coffee.png", "grass.png",
    "gravel.png", "rocket.jpg",
)  # fmt: skip
THEMES: Final = {
    "twentyeleven/images/patterns": ("pattern-flower.jpg",),
    "twentyfifteen/assets": ("pier-seagull.jpg",),
    "twentyfourteen/images": ("bridge.jpg", "street.jpg"),
    "twentyseventeen/assets/images": ("header.jpg",),
    "twentyten/images/patterns": ("pattern-barn.jpg", "pattern-dock.jpg"),
    "twentytwelve/images": ("pattern-jumble-1.jpg",),
    "twentytwentyfour/assets/images": (
        "abstract-geometric-art.webp", "angular-roof.webp", "art-gallery.webp",
        "building-exterior.webp", "green-staircase.webp", "museum.webp",
        "tourist-and-building.webp", "windows.webp",
    ),
}  # fmt: skip


def main(themes: Path) -> None:
    """Crop each photo to its middle, reduce it, and write it as JPEG without metadata."""
    skimage = importlib.util.find_spec("skimage")
    assert skimage is not None
    assert skimage.origin is not None
    sources = {f"skimage_{name}": Path(skimage.origin).parent / "data" / name for name in SKIMAGE}
    for folder, names in THEMES.items():
        theme = folder.partition("/")[0]
        sources |= {f"{theme}_{name}": themes / folder / name for name in names}
    FOLDER.mkdir(exist_ok=True)
    for name, path in sources.items():
        with Image.open(path) as photo:
            cut = ImageOps.fit(photo.convert("RGB"), SIZE, Image.Resampling.LANCZOS)
        cut.save(FOLDER / Path(name).with_suffix(".jpg"), quality=QUALITY, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
