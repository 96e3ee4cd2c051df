"""Make the tutorials' pictures anew: figures of a bench simulated as the tutorials do it."""

import tempfile
from pathlib import Path

from pipeline.output import write_file
from pipeline.report.draft.content import build_document
from pipeline.report.figures.svg import plain_svg
from pipeline.report.solution.write import build_solution
from pipeline.submission import load_submission
from pipeline.synthesis.hidden import prepare_bench, write_bench
from pipeline.workflow import analyse

IMAGES = Path(__file__).parent / "images"
FIGURES = {
    "bode-cart-1": "bode.svg",
    "decay-cart-2": "decay.svg",
    "free-bodies": "free-bodies.svg",
}


def main() -> None:
    """Write every picture."""
    with tempfile.TemporaryDirectory() as folder:
        hide = ["coulomb_friction:cart=2,force=0.002"]
        bench = prepare_bench(preset="throne-2dof", model=None, hide=hide)
        out = Path(folder) / "bench-4"
        write_bench(out, bench, seed=7, reported=False)
        analysis = analyse(load_submission(out))
    for document in (build_document(analysis, progress=None), build_solution(analysis)):
        for picture in document.pictures():
            if picture.name in FIGURES:
                write_file(IMAGES / FIGURES[picture.name], plain_svg(picture.svg))


if __name__ == "__main__":
    main()
