"""Where the project and the measurements beside it lie."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Real measurements may be used in place but not passed on, so they lie outside the project.
REAL_DATA = ROOT.parent / "shared" / "data"
