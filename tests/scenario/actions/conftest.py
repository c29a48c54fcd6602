"""What the tests of actions share."""

import pytest


@pytest.fixture
def write(request, tmp_path):
    """Return a function that writes the scenario of a module, ``BASE``, and its ``ACTIONS``."""

    def written(actions=request.module.ACTIONS, base=request.module.BASE):
        path = tmp_path / "acted.toml"
        path.write_text(base + actions)
        return path

    return written
