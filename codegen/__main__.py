"""Write the columns and the compiled laws of all effects."""

import subprocess
import sys
from pathlib import Path

from codegen.laws import columns_source, laws_source
from pipeline.output import write_file
from pipeline.plant import nonlinear
from pipeline.plant.nonlinear.effects import CATALOGUE

ROOM = Path(nonlinear.__file__).parent
MADE = {"columns.py": columns_source, "simulator/laws.py": laws_source}


def main() -> None:
    """Write each file, formatted."""
    for name, source in MADE.items():
        write_file(ROOM / name, source(CATALOGUE))
    files = [str(ROOM / name) for name in MADE]
    subprocess.run([sys.executable, "-m", "ruff", "format", "--quiet", *files], check=True)


if __name__ == "__main__":
    main()
