"""A user package is found by its entry points and used if its name is enabled."""

import shutil
import sys
from importlib.util import spec_from_file_location

import pytest
import yaml

from dopepp import PoseEstimator
from dopepp.core import extensions
from dopepp.core.errors import UserError
from dopepp.experiment.assembly.build_sources import labelled_images
from dopepp.models.network import BACKBONES
from dopepp.virtual.renderers import find_renderer

FILES = {
    "mine/__init__.py": "",
    "mine/backbones.py": """
from torch import nn
from dopepp.models.backbones import Backbone

class Tiny(Backbone):
    def __init__(self, channels: int = 8, norm: nn.Module | None = None) -> None:
        super().__init__()
        self.layers, self.out_channels = nn.Conv2d(3, channels, 8, stride=8), channels

    def forward(self, images):
        return self.layers(images)
""",
    "mine/grey.py": "render = print",
    "mine/reader.py": "def open_images(data, root, parts, seed, split): return root, split",
    "mine/conf/model/backbone/tiny.yaml": "_target_: mine.backbones.Tiny\nchannels: 16\n",
    "mine/conf/experiment/mine.yaml": """# @package _global_
defaults:
  - override /model/backbone: tiny
extensions: [mine]
""",
    "mine-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n",
    "mine-1.0.dist-info/entry_points.txt": """
[dopepp.backbones]
tiny = mine.backbones:Tiny
[dopepp.renderers]
grey = mine.grey
[dopepp.formats]
posed = mine.reader:open_images
[dopepp.conf]
mine = mine.conf
""",
}


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Install the package ``mine``; return its folder."""
    site = tmp_path / "site"
    for name, text in FILES.items():
        path = site / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv(extensions.VARIABLE, "")
    for name in [name for name in sys.modules if name.split(".")[0] == "mine"]:
        monkeypatch.delitem(sys.modules, name)
    return site


def test_a_backbone_trains_and_a_checkpoint_loads(mine, call, tiny_options, tmp_path, monkeypatch):
    run = f"hydra.run.dir={tmp_path / 'run'}"
    call("train.py", *tiny_options, "trainer.max_steps=2", "experiment=mine", run, code=0)
    path = tmp_path / "run" / "checkpoints" / "last.ckpt"
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert config["extensions"] == ["mine"]
    monkeypatch.setenv(extensions.VARIABLE, "")
    with pytest.raises(UserError, match=r"_target_ 'mine\.backbones\.Tiny'.*extensions=\[mine\]"):
        PoseEstimator.load(path)
    network = PoseEstimator.load(path, extensions=["mine"]).network
    assert network.backbone.out_channels == 16


def test_a_package_that_is_not_enabled_is_not_imported(mine, call, tiny_options, tmp_path):
    output = f"output_dir={tmp_path / 'o'}"
    done = call("train.py", *tiny_options, "model/backbone=tiny", output, code=2)
    assert "extensions=[mine]" in done.line
    assert "mine" not in sys.modules
    with pytest.raises(
        UserError, match=r"extensions=\[other\]; allowed: mine; fix: pip install other"
    ):
        extensions.enable(["other"])
    with pytest.raises(UserError, match="install the package absent and enable it"):
        BACKBONES.resolve("absent.Net")


def test_arguments_of_its_classes_have_the_annotated_types(mine):
    extensions.enable(["mine"])
    node = {"_target_": "mine.backbones.Tiny"}
    assert BACKBONES.build({**node, "channels": 16, "norm": None}).out_channels == 16
    for argument in ({"channels": "16"}, {"channels": 8.5}, {"norm": "BatchNorm2d"}):
        with pytest.raises(UserError, match=rf"backbone\.{next(iter(argument))}="):
            BACKBONES.build({**node, **argument})


class Finder:
    """Finds ``mine`` in a folder off ``sys.path``, as a flat-layout editable install does."""

    def __init__(self, site):
        self.site = site

    def find_spec(self, name, path=None, target=None):
        if name != "mine":
            return None
        file = self.site / "mine" / "__init__.py"
        return spec_from_file_location(name, file, submodule_search_locations=[str(file.parent)])


def test_config_folders_of_an_editable_install(mine, tmp_path, monkeypatch):
    shutil.move(mine / "mine", tmp_path / "checkout" / "mine")
    assert list(extensions.config_folders()) == []
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, Finder(tmp_path / "checkout")])
    folder = tmp_path / "checkout" / "mine" / "conf"
    assert list(extensions.config_folders()) == [("mine", folder)]
    assert "mine" not in sys.modules


def test_renderers_and_formats_are_found_by_name(mine, tiny):
    config = tiny("data.format=posed", f"data.root={mine}").data
    for find in (lambda: find_renderer("grey"), lambda: labelled_images(config, [], 0, "val")):
        with pytest.raises(UserError, match=r"extensions=\[mine\]"):
            find()
    extensions.enable(["mine"])
    assert find_renderer("grey") is print
    assert labelled_images(config, [], 0, "val") == (mine, "val")
