"""The choice of Mitsuba's variant: a libLLVM that crashes must not crash the user's process."""

import os
import subprocess
import sys

import pytest

from dopepp.core.errors import UserError
from dopepp.virtual.renderers import photoreal as variant

_RENDER = """
import logging, os
from dopepp.core.errors import UserError
from dopepp.virtual.renderers.photoreal import mitsuba
logging.basicConfig(level=logging.INFO)
try:
    print("variant", mitsuba().variant(), flush=True)
    child = os.fork()
    if child:
        os.waitpid(child, 0)
    else:
        mitsuba()
except UserError as error:
    print(error, flush=True)
os._exit(0)
"""


@pytest.fixture(autouse=True)
def mitsuba_is_installed():
    pytest.importorskip("mitsuba", reason="the extra photoreal is not installed")


@pytest.fixture
def library(tmp_path, monkeypatch):
    """A file that stands for a libLLVM, with the user's cache in a folder of its own."""
    path = tmp_path / "libLLVM-15.so.1"
    path.write_bytes(b"\0" * 2_000_000)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv(variant.LIBRARY_SETTING, str(path))
    monkeypatch.delenv(variant.VARIANT_SETTING, raising=False)
    return path


def stand_in(monkeypatch, code):
    """Run other code in place of the trial; return the list of commands so far."""
    commands = []
    run = subprocess.run

    def record(command, **options):
        commands.append(command)
        return run([sys.executable, "-c", code], **options)

    monkeypatch.setattr(subprocess, "run", record)
    return commands


@pytest.mark.parametrize(
    "code", ["import os; os.abort()", "raise SystemExit(1)", "print('LLVM ERROR')"]
)
def test_a_library_that_ends_the_process_is_not_usable(library, monkeypatch, code):
    stand_in(monkeypatch, code)
    assert not variant.is_usable(library)


def test_the_outcome_is_cached_until_the_library_changes(library, monkeypatch, tmp_path):
    commands = stand_in(monkeypatch, "print('mean', 0.5)")
    assert [variant.is_usable(library) for _ in range(2)] == [True, True]
    assert len(commands) == 1
    (cached,) = (tmp_path / "cache" / "dopepp" / "libllvm").iterdir()
    for count, damage in enumerate((b"", b"tru", b"\xff" * 1000), start=2):
        cached.write_bytes(damage)  # a damaged file is written again
        assert variant.is_usable(library)
        assert len(commands) == count
        assert cached.read_text() == "true"
    os.utime(library, (1, 1))
    assert variant.is_usable(library)
    assert len(commands) == 5


def test_a_trial_that_times_out_is_repeated_later(library, monkeypatch):
    def hang(command, timeout, **_):
        raise subprocess.TimeoutExpired(command, timeout)

    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "run", hang)
        assert not variant.is_usable(library)
    stand_in(monkeypatch, "print('mean', 0.5)")
    assert variant.is_usable(library)


@pytest.mark.parametrize("number", ["0", "-1", "many", ""])
def test_a_wrong_number_of_threads(monkeypatch, number):
    monkeypatch.setenv(variant.THREADS_SETTING, "3")
    assert variant.num_threads() == 3
    monkeypatch.setenv(variant.THREADS_SETTING, number)
    with pytest.raises(UserError, match="DOPEPP_RENDER_THREADS"):
        variant.num_threads()


def test_the_newest_library_comes_first(library, monkeypatch, tmp_path):
    assert variant.candidates() == [library]
    monkeypatch.delenv(variant.LIBRARY_SETTING)
    monkeypatch.setattr(variant, "LIBRARY_PATTERNS", (f"{tmp_path}/libLLVM*.so.*",))
    (tmp_path / "libLLVM.so.19.1").touch()
    (tmp_path / "libLLVM-9.so.1").touch()
    (tmp_path / "libLLVM-15.0.7.so.1").symlink_to(library)
    (tmp_path / "libLLVM-22.so").touch()  # without a number at its end: text for the linker
    names = [path.name for path in variant.candidates()]
    assert names == ["libLLVM.so.19.1", "libLLVM-15.so.1", "libLLVM-9.so.1"]


@pytest.mark.render
@pytest.mark.parametrize(
    ("setting", "answers"),
    [
        (None, ["variant scalar_rgb", "spawn"]),  # a fork lacks the threads of its parent
        ("scalar_rgb", ["variant scalar_rgb"]),
        ("llvm_ad_rgb", ["DOPEPP_MITSUBA_VARIANT=llvm_ad_rgb", "libLLVM-15"]),
        ("cuda_ad_rgb", ["DOPEPP_MITSUBA_VARIANT='cuda_ad_rgb'", "llvm_ad_rgb, scalar_rgb"]),
    ],
)
def test_a_process_survives_an_invalid_library(library, setting, answers):
    wish = {} if setting is None else {variant.VARIANT_SETTING: setting}
    done = subprocess.run(
        [sys.executable, "-c", _RENDER], capture_output=True, text=True, check=False, timeout=120,
        env={**os.environ, variant.THREADS_SETTING: "1", **wish},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for answer in answers:
        assert answer in done.stdout
    tried = setting in (None, "llvm_ad_rgb")
    assert (f"{library} does not work with Mitsuba" in done.stderr) == tried
    assert (library.parent / "cache").exists() == tried
