"""Find the templates, rubrics and worked examples, next to the package or inside it."""

from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_BUNDLED = _PACKAGE / "_resources"  # in an installed wheel
_ROOT = _BUNDLED if _BUNDLED.is_dir() else _PACKAGE.parent  # in a checkout

TEMPLATES = _ROOT / "templates"
RUBRICS = _ROOT / "rubrics"
EXAMPLES = _ROOT / "submissions"
