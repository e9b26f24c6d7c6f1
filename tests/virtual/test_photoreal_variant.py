"""The choice of Mitsuba's variant: a libLLVM that kills its process must not kill the user's."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dopepp.errors import UserError
from dopepp.virtual import photoreal_variant as variant

_RENDER = """
import logging
logging.basicConfig(level=logging.INFO)
from dopepp.virtual.photoreal_variant import mitsuba
print("variant", mitsuba().variant())
"""


@pytest.fixture
def library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that stands for a libLLVM, with the user's cache in a folder of its own."""
    path = tmp_path / "libLLVM-15.so.1"
    path.write_bytes(b"\0" * 2_000_000)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(variant.LIBRARY_SETTING, str(path))
    monkeypatch.delenv(variant.VARIANT_SETTING, raising=False)
    return path


def stand_in(monkeypatch: pytest.MonkeyPatch, code: str) -> list[list[str]]:
    """Let the probe run other code in its process; return the list of commands that were run."""
    commands: list[list[str]] = []
    run = subprocess.run

    def record(command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return run(command, **options)

    monkeypatch.setattr(variant, "_PROBE", code)
    monkeypatch.setattr(subprocess, "run", record)
    return commands


@pytest.fixture(autouse=True)
def mitsuba_is_installed() -> None:
    pytest.importorskip("mitsuba", reason="the extra photoreal is not installed")


@pytest.mark.parametrize(
    "code", ["import os; os.abort()", "raise SystemExit(1)", "print('LLVM ERROR')"]
)
def test_a_library_that_ends_the_process_is_passed_over(
    library: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    code: str,
) -> None:
    commands = stand_in(monkeypatch, code)
    with caplog.at_level(logging.INFO):
        assert variant._chosen_library() is None
    assert f"{library} does not work with Mitsuba" in caplog.text
    assert commands[0][0] == sys.executable


def test_the_outcome_is_remembered_until_the_library_changes(
    library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = stand_in(monkeypatch, "print('mean', 0.5)")
    assert variant._chosen_library() == library
    assert variant._chosen_library() == library
    assert len(commands) == 1
    os.utime(library, (1, 1))
    assert variant._chosen_library() == library
    assert len(commands) == 2


def test_a_damaged_memory_is_written_anew(
    library: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stand_in(monkeypatch, "print('mean', 0.5)")
    cache = tmp_path / "cache" / "dopepp" / "mitsuba_libllvm.json"
    cache.parent.mkdir(parents=True)
    for damage in ("[" * 100_000, "{", "[1]", '{"a": "b"}', ""):
        cache.write_text(damage)
        assert variant._chosen_library() == library
        assert list(json.loads(cache.read_text()).values()) == [True]


def test_a_probe_without_an_end_is_tried_again_later(
    library: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    commands = stand_in(monkeypatch, "import time; time.sleep(60)")
    monkeypatch.setattr(variant, "_PROBE_SECONDS", 0.3)
    assert variant._chosen_library() is None
    assert f"{library} could not be tried" in caplog.text
    assert variant._chosen_library() is None
    assert len(commands) == 2


def test_an_unusable_library_cannot_be_insisted_on(
    library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(monkeypatch, "import os; os.abort()")
    monkeypatch.setenv(variant.VARIANT_SETTING, "llvm_ad_rgb")
    with pytest.raises(UserError, match=r"DOPEPP_MITSUBA_VARIANT=llvm_ad_rgb with .*libLLVM-15"):
        variant._chosen_library()


def test_the_scalar_variant_tries_no_library(
    library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert library.exists()
    commands = stand_in(monkeypatch, "print('mean', 0.5)")
    monkeypatch.setenv(variant.VARIANT_SETTING, "scalar_rgb")
    assert variant._chosen_library() is None
    assert not commands


def test_a_wrong_variant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(variant.VARIANT_SETTING, "cuda_ad_rgb")
    with pytest.raises(UserError, match=r"DOPEPP_MITSUBA_VARIANT='cuda_ad_rgb'.*llvm_ad_rgb"):
        variant._chosen_library()


@pytest.mark.parametrize("number", ["0", "-1", "many", ""])
def test_a_wrong_number_of_threads(monkeypatch: pytest.MonkeyPatch, number: str) -> None:
    monkeypatch.setenv(variant.THREADS_SETTING, number)
    with pytest.raises(UserError, match="DOPEPP_RENDER_THREADS"):
        variant.num_threads()


def test_threads_are_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(variant.THREADS_SETTING, "3")
    assert variant.num_threads() == 3


def test_names_give_versions_and_linker_scripts_are_no_libraries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(variant.LIBRARY_SETTING, raising=False)
    monkeypatch.setattr(variant, "_PLACES", (f"{tmp_path}/libLLVM*.so*",))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "nothing"))
    monkeypatch.setenv("RUSTUP_HOME", str(tmp_path / "nothing"))
    for name in ("libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM-17.so", "libLLVM.so"):
        (tmp_path / name).write_bytes(b"\0" * 2_000_000)
    (tmp_path / "libLLVM-22.so").write_text("INPUT(libLLVM.so.22.1)")
    names = [path.name for path in variant.candidates()]
    assert names == ["libLLVM.so.19.1", "libLLVM-17.so", "libLLVM-14.so.1", "libLLVM.so"]


@pytest.mark.render
def test_a_real_process_survives_a_library_that_is_none(library: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _RENDER], capture_output=True, text=True, check=False,
        env={**os.environ, variant.THREADS_SETTING: "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "variant scalar_rgb" in done.stdout
    assert f"{library} does not work with Mitsuba" in done.stderr


@pytest.mark.render
def test_a_process_forked_after_the_first_image_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(variant, "_start", lambda: os.getpid() + 1)
    with pytest.raises(UserError, match=r"forked from one.*get_context\('spawn'\)"):
        variant.mitsuba()
