import pytest

from dopepp.core.errors import UserError
from dopepp.parts import read_mesh
from tests.parts.makers import solid_of


@pytest.fixture(scope="session")
def volume():
    """Return a mesh's volume, after checking that it is a solid that faces outwards."""

    def measure(mesh):
        solid = solid_of(mesh)
        assert solid.is_volume
        return float(solid.volume)

    return measure


@pytest.fixture
def write(tmp_path):
    """Write a file into the test's folder."""

    def write(name, content):
        path = tmp_path / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return write


@pytest.fixture
def refused(write):
    """Read a file that must be refused in one line that names it."""

    def refused(name, content, match):
        path = write(name, content)
        with pytest.raises(UserError, match=match) as caught:
            read_mesh(path, "mm")
        assert str(path.parent) in str(caught.value)
        assert "\n" not in str(caught.value)

    return refused
