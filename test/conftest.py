"""What several test folders share."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def repository():
    """Return the root of the checkout."""
    return Path(__file__).resolve().parent.parent
