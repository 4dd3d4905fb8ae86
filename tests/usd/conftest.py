from functools import partial

import pytest
from usd.stages import write


@pytest.fixture
def stage(tmp_path):
    """Function that writes the text of a stage to a file, and returns its path."""
    return partial(write, tmp_path)
