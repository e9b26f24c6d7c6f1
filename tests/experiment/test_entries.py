"""``dopepp train`` and ``dopepp evaluate``: early answers, files of rejected runs, completion."""

import json
import re

import pytest

from dopepp.experiment.command_line import complete

CONSOLE = """
import contextlib, io, json, sys
from dopepp.cli import app
ends = []
for words in json.loads(sys.argv[1]):
    sys.argv, output = ["dopepp", *words], io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            app()
        except SystemExit as end:
            ends.append((end.code or 0, output.getvalue()))
print(json.dumps([ends, list({"torch", "lightning", "cv2"} & set(sys.modules))]))
"""
ANSWERS = {
    "train sed=1": (2, "got override 'sed', which names no option; .* nearest seed; "),
    "evaluate model=dope": (2, "got override 'model', which names no option; "),
    "train model=dopp": (2, "got model=dopp; allowed: dope dopepp dopepp_fast; "),
    "train --cfg job model=dope --package optimizer": (0, "lr: "),
    "evaluate --help": (0, "ckpt_path: null"),
    "--version": (0, r"dopepp \d+\.\d+"),
}


def test_the_console_answers_before_pytorch_is_imported(command):
    done = command("-c", CONSOLE, json.dumps([words.split() for words in ANSWERS]), code=0)
    ends, imported = json.loads(done.out)
    assert imported == []
    for (words, (code, pattern)), (ended, output) in zip(ANSWERS.items(), ends, strict=True):
        assert (ended, bool(re.search(pattern, output))) == (code, True), (words, output)


def test_a_rejected_run_leaves_no_folder(call, tiny_options, tmp_path):
    output = f"output_dir={tmp_path}"
    call("train.py", *tiny_options, "data.parts=[none.stl]", output, code=2)
    call("train.py", *tiny_options, "trainer.max_epochs=many", output, code=2)
    call("evaluate.py", "ckpt_path=none.ckpt", output, code=2)
    call("evaluate.py", "ckpt_path=pretrained/servoholder", "data.num_test=0", output, code=2)
    assert not list(tmp_path.iterdir())


def test_a_rejected_run_keeps_existing_files(call, tiny_options, tmp_path):
    (tmp_path / "mine.txt").touch()
    call("train.py", *tiny_options, "data.parts=[none.stl]", f"hydra.run.dir={tmp_path}", code=2)
    assert (tmp_path / "mine.txt").is_file()


@pytest.mark.parametrize(
    ("words", "incomplete", "expected"),
    [
        ([], "model=dopepp_", ["model=dopepp_fast"]),
        (["model", "="], "dopepp_", ["dopepp_fast"]),  # as bash splits it
        ([], "recip", ["recipe=ours", "recipe=paper"]),
        (["recipe=paper"], "trainer.max_ep", ["trainer.max_epochs=60"]),
        ([], "virtual.scene.sensors.noise", ["virtual.scene.sensors.noise_probability=0.5"]),
        (["virtual.preset=wide"], "virtual.scene.hor", ["virtual.scene.horizontal_fov_deg=60.0"]),
        ([], "no_such", []),
    ],
)
def test_the_shell_completes_overrides(words, incomplete, expected):
    assert complete("train", words, incomplete) == expected
