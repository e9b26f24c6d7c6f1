"""Functions that run commands in this process."""

import pytest
from typer.testing import CliRunner

from dopepp.cli import app
from dopepp.parts.catalogue import pivconnector
from dopepp.virtual import PRESETS, Factory


@pytest.fixture(scope="session")
def rendered():
    """A rendered image of a pivconnector, 640×480 pixels, with its scene."""
    return Factory([pivconnector()], PRESETS["quickstart"].reframed(640, 480), 2).render(0, 9)


@pytest.fixture(scope="session")
def intrinsics(rendered):
    """The option ``--K`` of the rendered image."""
    return ("--K", *rendered.scene.K[[0, 1, 0, 1], [0, 1, 2, 2]])


@pytest.fixture(scope="session")
def run():
    """Run ``dopepp``, which must exit with ``code`` and never with a traceback."""

    def run(*words, code=0):
        done = CliRunner().invoke(app, [str(word) for word in words])
        assert done.exit_code == code, done.output
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        return done

    return run


@pytest.fixture(scope="session")
def refused(run):
    """Run ``dopepp`` with wrong input; return the single line of its error message."""

    def refused(*words):
        done = run(*words, code=2)
        assert done.stderr.count("\n") == 1, done.stderr
        assert "Traceback" not in done.stderr
        return done.stderr

    return refused
