"""Folders of the project and of the measurements beside it."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# Real measurements may be used here but not passed on, so they are outside the project.
REAL_DATA = ROOT.parent / "shared" / "data"
