"""Write all that is made from the effects' laws: columns, compiled laws, and the effects' page."""

import subprocess
import sys
from pathlib import Path

from docs.codegen.forces import columns_source, forces_source, terms_source
from pipeline.output import write_file
from pipeline.plant import simulator
from pipeline.plant.catalogue import CATALOGUE

ROOM = Path(simulator.__file__).parent
MADE = {
    "columns.py": columns_source,
    "generated_forces.py": forces_source,
    "terms.py": terms_source,
}


def main() -> None:
    """Write each file; another process, which loads the new columns, makes the page."""
    for name, source in MADE.items():
        write_file(ROOM / name, source(CATALOGUE))
    files = [str(ROOM / name) for name in MADE]
    subprocess.run([sys.executable, "-m", "ruff", "format", "--quiet", *files], check=True)
    subprocess.run([sys.executable, "-m", "docs.effects_page"], check=True)


if __name__ == "__main__":
    main()
