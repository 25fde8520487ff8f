"""A `vtfs tune` that takes a second."""

from pathlib import Path

import pytest

from tests.command_line import short_repeats


@pytest.fixture
def quick_tune(own_folder):
    """With two spaces in the folder: of tiled techniques, and of a single configuration."""
    Path("space.toml").write_text("[parameters]\ntile_px = [16, 32]\n")
    Path("forward.toml").write_text("[parameters]\nbatch = [0]\n")
    with short_repeats():
        yield
