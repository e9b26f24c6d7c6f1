"""Compiled functions: the first compilation is logged once; cached code is not compiled."""


def test_compiling_is_logged_once(command, tmp_path):
    module = tmp_path / "loops.py"
    module.write_text(
        "import logging\n"
        "logging.basicConfig(level=logging.INFO, format='%(message)s')\n"
        "from dopepp.core.compiled import compiled\n"
        "@compiled()\n"
        "def add(x, y):\n"
        "    return x + y\n"
        "print(add(1, 2), add(1.5, 2))\n"
    )
    first, second = command(str(module)), command(str(module))
    assert first.out == second.out == "3 3.5\n"
    assert first.err.count("compiling") == 1
    assert second.err == ""


def test_a_first_compilation_calls_functions_in_a_second_process(command, tmp_path):
    (tmp_path / "later.py").write_text(
        f"from pathlib import Path\ndef call(): Path({str(tmp_path / 'called')!r}).touch()\n"
    )
    module = tmp_path / "loops.py"
    module.write_text(
        "import gc, time\n"
        "from pathlib import Path\n"
        "from dopepp.core.compiled import compile_in_background, compiled\n"
        "compile_in_background('later:call')\n"
        "@compiled()\n"
        "def double(x):\n"
        "    return x + x\n"
        "print(double(1), gc.isenabled())\n"
        "called = Path(__file__).with_name('called')\n"
        "until = time.monotonic() + 30\n"
        "while not called.exists() and time.monotonic() < until: time.sleep(0.05)\n"
        "print(called.exists())\n"
    )
    assert command(str(module)).out == "2 True\nTrue\n"
