"""Fixtures shared by the tests."""

from pathlib import Path

import pytest

# Real measurements may be used in place but not passed on, so they lie outside the project.
REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real measurements; tests that need it skip where it is absent."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"real measurements are not here ({REAL_DATA})")
    return REAL_DATA
