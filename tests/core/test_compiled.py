"""Compiled functions: the first compilation is announced, once, and none that is on disk."""


def test_compiling_is_announced_once_and_never_again(command, tmp_path):
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
