import pytest

from dopepp.data.render_job import make_job


@pytest.fixture(scope="session")
def small_job():
    """Make a job of small images, changed as asked."""

    def make(layout="bop", **options):
        defaults = {"preset": "quickstart", "size": "32x24", "layout": layout}
        return make_job(["servoholder"], **defaults | options)

    return make
