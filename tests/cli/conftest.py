"""Commands as they are typed, inside this process."""

import pytest
from typer.testing import CliRunner

from dopepp.cli import app


@pytest.fixture(scope="session")
def run():
    """Run ``dopepp`` with some words; it must end with ``code``, and never in a traceback."""

    def run(*words, code=0):
        done = CliRunner().invoke(app, [str(word) for word in words])
        assert done.exit_code == code, done.output
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        return done

    return run


@pytest.fixture(scope="session")
def refused(run):
    """Run ``dopepp`` with a mistake; return the one line that names it."""

    def refused(*words):
        done = run(*words, code=2)
        assert done.stderr.count("\n") == 1, done.stderr
        assert "Traceback" not in done.stderr
        return done.stderr

    return refused
