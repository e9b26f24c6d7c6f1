"""The site of the pages: navigation, build by two builders without broken links, notebook."""

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
import yaml

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "docs" / "notebooks" / "from_stl_to_poses.ipynb"


def named(node):
    """Return the pages below a node of the navigation, in order."""
    if isinstance(node, str):
        return [node]
    children = node.values() if isinstance(node, dict) else node
    return [page for child in children for page in named(child)]


def test_the_navigation_names_every_page_once():
    pages = named(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])
    docs = ROOT / "docs"
    assert sorted(pages) == sorted(str(path.relative_to(docs)) for path in docs.rglob("*.md"))


@pytest.mark.slow
@pytest.mark.parametrize("builder", ["mkdocs", "zensical"])
def test_the_site_builds_without_warnings(builder, tmp_path):
    """Build a copy, because Zensical writes its site and cache next to the configuration."""
    for name in ("docs", "dopepp"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "mkdocs.yml", tmp_path)
    command = [sys.executable, "-m", builder, "build", "--strict"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    site = tmp_path / "build" / "site"
    for page in named(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]):
        folder = "" if page == "index.md" else page.removesuffix(".md")
        assert (site / folder / "index.html").is_file()
    reference = (site / "reference" / "api" / "index.html").read_text()
    assert "T_cam_obj" in reference
    assert "PoseEstimator" in reference
    assert ":class:" not in reference


def test_the_page_contains_the_cells_of_the_notebook():
    page = (ROOT / "docs" / "tutorials" / "from_stl_to_poses.md").read_text()
    notebook = json.loads(NOTEBOOK.read_text())
    for cell in notebook["cells"]:
        source = "".join(cell["source"]).strip()
        assert source in page
        assert not cell.get("outputs")
    images = list((ROOT / "docs" / "tutorials" / "from_stl_to_poses").glob("*.jpg"))
    assert images
    assert sum(path.stat().st_size for path in images) < 300_000


def test_imports_of_scripts_and_notebook_exist():
    scripts = {str(path): path.read_text() for path in (ROOT / "benchmarks").glob("*.py")}
    scripts |= {str(path): path.read_text() for path in (ROOT / "docs").rglob("*.py")}
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    scripts[str(NOTEBOOK)] = "\n".join(code)
    missing = []
    for path, source in scripts.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dopepp"):
                for name in node.names:
                    try:
                        exec(f"from {node.module} import {name.name}", {})
                    except ImportError as error:
                        missing.append(f"{path}: {error}")
    assert missing == []


@pytest.mark.slow
def test_the_notebook_runs(monkeypatch, tmp_path):
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = nbclient.NotebookClient(notebook, resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    printed = "".join(
        item.get("text", "") for cell in client.nb.cells for item in cell.get("outputs", [])
    )
    assert "refined: found on 20 of 20" in printed
