"""Where the OpenGL renderer refuses to run, and what it says."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dopepp.errors import UserError
from dopepp.virtual import gl_context


class FakeContext:
    version_code = 450

    def __init__(self, name: str) -> None:
        self.info = {"GL_RENDERER": name}
        self.released = False

    def release(self) -> None:
        self.released = True


def install(monkeypatch: pytest.MonkeyPatch, *names: str) -> list[FakeContext]:
    """Stand EGL devices with these renderers in for the machine's."""
    made: list[FakeContext] = []

    def create_context(device_index: int, **_: Any) -> FakeContext:
        if device_index >= len(names):
            raise Exception(f"requested device index {device_index}")  # as glcontext does
        made.append(FakeContext(names[device_index]))
        return made[-1]

    monkeypatch.setattr(gl_context, "require_moderngl", lambda: None)
    monkeypatch.setitem(sys.modules, "moderngl", SimpleNamespace(create_context=create_context))
    monkeypatch.delenv(gl_context.SOFTWARE_SETTING, raising=False)
    return made


@pytest.mark.parametrize("name", ["llvmpipe (LLVM 15.0.6, 256 bits)", "softpipe", "Mesa SWRast"])
def test_a_software_renderer_is_refused(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    made = install(monkeypatch, name)
    with pytest.raises(UserError, match=r"software renderer found.*fix: use renderer=raster"):
        gl_context.open_context()
    assert made[0].released


def test_a_software_renderer_is_taken_when_it_is_admitted(monkeypatch: pytest.MonkeyPatch) -> None:
    made = install(monkeypatch, "llvmpipe")
    assert gl_context.open_context(admit_software=True) is made[0]
    monkeypatch.setenv(gl_context.SOFTWARE_SETTING, "1")
    assert gl_context.open_context() is made[1]
    with pytest.raises(UserError, match="software renderer found"):
        gl_context.open_context(admit_software=False)


def test_hardware_behind_a_software_device_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    made = install(monkeypatch, "llvmpipe", "NVIDIA H100/PCIe/SSE2")
    assert gl_context.open_context() is made[1]
    assert made[0].released


def test_a_machine_without_opengl(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch)
    with pytest.raises(UserError, match=r"no OpenGL context.*requested device index 0.*raster"):
        gl_context.open_context()


def test_a_wrong_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, "llvmpipe")
    monkeypatch.setenv(gl_context.SOFTWARE_SETTING, "maybe")
    with pytest.raises(UserError, match=r"DOPEPP_GL_SOFTWARE='maybe'.*0 or 1"):
        gl_context.open_context()


def test_the_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "moderngl", None)
    monkeypatch.delitem(sys.modules, "dopepp.virtual.gl", raising=False)
    with pytest.raises(UserError, match=r"moderngl.*pip install 'dopepp\[gl\]'"):
        importlib.import_module("dopepp.virtual.gl")


_FORKING = """
import multiprocessing, sys
from dopepp.virtual import gl_context

def report(connection):
    try:
        gl_context.check_process()
    except ValueError as error:
        connection.send(str(error))
    else:
        connection.send("fine")

if __name__ == "__main__":
    context = multiprocessing.get_context(sys.argv[1])
    here, there = context.Pipe()
    process = context.Process(target=report, args=(there,))
    process.start()
    print(here.recv())
    process.join()
"""


@pytest.mark.parametrize(
    ("method", "answer"), [("fork", "in a process that was forked"), ("spawn", "fine")]
)
def test_only_forked_workers_are_refused(tmp_path: Path, method: str, answer: str) -> None:
    # In a process of its own: this one may have a context, whose threads a fork would lack.
    script = tmp_path / "start_worker.py"
    script.write_text(_FORKING)
    done = subprocess.run(
        [sys.executable, str(script), method], capture_output=True, text=True, timeout=60,
        check=True,
    )  # fmt: skip
    assert answer in done.stdout
    assert ("set data.num_workers=0" in done.stdout) == (method == "fork")
