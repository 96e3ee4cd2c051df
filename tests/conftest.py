"""Fixtures shared by the tests."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# The same examples every time, and no verdict on how fast a busy machine is.
settings.register_profile(
    "cartlab", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("cartlab")

# Real measurements may be used in place but not passed on, so they lie outside the project.
REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of real measurements; tests that need it skip where it is absent."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"real measurements are not here ({REAL_DATA})")
    return REAL_DATA
