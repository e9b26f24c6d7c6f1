"""Executes the notebooks and writes them as pages, with their pictures as JPEG.

python docs/notebooks/render.py
"""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import nbformat
import numpy as np
from nbclient import NotebookClient

FOLDER = Path(__file__).parent
PAGES = FOLDER.parent / "tutorials"
JPEG_QUALITY = 85


def page_of(notebook: nbformat.NotebookNode, name: str) -> str:
    """Return an executed notebook as Markdown; its pictures go to ``docs/tutorials/NAME/``."""
    blocks = []
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            blocks.append(cell.source)
            continue
        blocks.append(f"```python\n{cell.source}\n```")
        printed = "".join(text_of(output) for output in cell.outputs).strip()
        if printed:
            blocks.append(f"```text\n{printed}\n```")
        pictures = [
            one.data["image/png"] for one in cell.outputs if "image/png" in one.get("data", {})
        ]
        blocks += [f"![what it shows]({write_picture(one, name)})" for one in pictures]
    return "\n\n".join(blocks) + "\n"


def text_of(output: nbformat.NotebookNode) -> str:
    """Return what a cell has printed or returned; of a picture, nothing."""
    data = output.get("data", {})
    return "" if "image/png" in data else str(output.get("text", data.get("text/plain", "")))


def write_picture(content: str, name: str) -> str:
    """Write a PNG of a notebook as the next JPEG of its page; return how the page calls it."""
    folder = PAGES / name
    folder.mkdir(exist_ok=True)
    path = folder / f"{len(list(folder.iterdir())) + 1}.jpg"
    image = cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_COLOR)
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return f"{name}/{path.name}"


def main() -> None:
    """Render every notebook."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=600).execute()
        for old in (PAGES / path.stem).glob("*.jpg"):
            old.unlink()
        (PAGES / f"{path.stem}.md").write_text(page_of(notebook, path.stem))


if __name__ == "__main__":
    main()
