"""Randomly damaged files of teachers and earlier runs give a result or one line for each fault."""

import json
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from random import Random

import pytest

from pipeline.bench.importing import Importer
from pipeline.errors import ConfigError
from pipeline.experiments.plan import load_plan, plan_path, plan_text
from pipeline.experiments.propose import propose_plan
from pipeline.gap.types import read_gap
from pipeline.grading.intake.find import read_late_table
from pipeline.grading.platforms import PLATFORMS, gradescope_metadata
from pipeline.grading.publish.roster import Roster, Student
from pipeline.grading.publish.survey import read_survey, survey_dict, survey_text
from pipeline.grading.publish.view import new_view
from pipeline.grading.rubric_file import load_rubric
from pipeline.json_files import json_text
from pipeline.report.changes import compare_drafts, read_results
from pipeline.report.gap_verdict import terminal_verdict
from pipeline.resources import RUBRICS
from pipeline.simulated.hidden import prepare_bench
from pipeline.submission import load_submission
from pipeline.submission.toml import MOST_LISTED
from tests.grading.publish.test_survey import write_paper
from tests.helpers.acquisitions import Notes, write_work
from tests.helpers.gaps import make_gap, two_cart_analysis
from tests.helpers.grades import make_grade
from tests.helpers.poison import (
    damaged,
    few_lines_at_most,
    poisoned_json,
    poisoned_table,
    poisoned_toml,
)
from tests.ingest.test_spoilt_files import FILES

ROSTERS: dict[str, str] = {
    "canvas": "Student,ID,SIS User ID,Section,Lab 3 (77)\nJane Doe,7,s1,A,\nBob,8,s2,A,4\n",
    "moodle": "Identifier,Full name,Email address,Grade\nParticipant 7,Jane Doe,s1,\n",
    "gradescope": "Name,SID,Email,Total Score\nJane Doe,s1,j@x,\nBob,s2,b@x,3\n",
}
NAMES = ("survey.csv", *(f"{name}.csv" for name in ROSTERS), "late.csv",
         "submission_metadata.yml", "rubric.toml", "plan.toml", "results.json", "gap.json",
         "model.json", "import")  # fmt: skip
LATE = "submission,days_late\nteam-1,0.5\nteam-2,2\nteam-3,0\n"
SENT = """submission_77001:
  :submitters:
  - :name: Jane Doe
  :created_at: 2024-05-01 10:00:00 Z
"""


@cache
def sound() -> dict[str, bytes]:
    """Return the good files, by name, that the tests spoil."""
    with tempfile.TemporaryDirectory() as folder:
        submission = load_submission(write_work(Path(folder), []))
        plan = plan_text(propose_plan(submission), submission.system).encode()
        survey = write_paper(Path(folder) / "survey.csv").read_bytes()
    analysis = two_cart_analysis()
    gap = json_text(make_gap(keys=("coulomb_friction", "input_delay"))).encode()
    return {
        "survey.csv": survey,
        **{f"{name}.csv": text.encode() for name, text in ROSTERS.items()},
        "late.csv": LATE.encode(),
        "submission_metadata.yml": SENT.encode(),
        "rubric.toml": (RUBRICS / "throne-2dof.toml").read_bytes(),
        "plan.toml": plan,
        "results.json": json_text(analysis).encode(),
        "gap.json": gap,
        "model.json": gap,
    }


def spoilt(name: str, rng: Random) -> bytes:
    """Return a good file with random changes of its bytes or of its values."""
    raw = FILES[rng.choice(sorted(FILES))] if name == "import" else sound()[name]
    if rng.random() < 0.5:
        return damaged(raw, rng)
    if name.endswith(".json"):
        return json.dumps(poisoned_json(json.loads(raw), rng)).encode()
    if name.endswith(".toml"):
        return poisoned_toml(raw.decode(), rng).encode("utf-8", "replace")
    if name.endswith(".csv"):
        try:
            return poisoned_table(raw.decode(), rng).encode("utf-8", "replace")
        except ValueError:  # some tables contain words
            return damaged(raw, rng)
    return damaged(raw, rng)


def use(name: str, path: Path) -> None:
    """Read a file with the function for its name, and use the result."""
    seen = new_view(make_grade("a"), load_rubric(Path("throne-2dof")))
    student = Student(id="s1", name="Jane Doe", number="7", view=seen)
    if name == "survey.csv":
        survey = read_survey(path)
        json.dumps(survey_dict(survey), allow_nan=False)
        survey_text(survey)
    elif path.stem in ROSTERS:
        roster = Roster.read(path, platform=PLATFORMS[path.stem])
        roster.fill([student], {"Lab 3": lambda student: "1"})
    elif name == "late.csv":
        read_late_table(path)
    elif name == "submission_metadata.yml":
        gradescope_metadata(path.parent)
    elif name == "rubric.toml":
        load_rubric(path)
    elif name == "plan.toml":
        work = write_work(path.parent / "work", [])
        plan_path(load_submission(work)).write_bytes(path.read_bytes())
        load_plan(load_submission(work))
    elif name == "results.json":
        compare_drafts(read_results(path), two_cart_analysis())
    elif name == "gap.json":
        gap = read_gap(path.read_text(encoding="utf-8", errors="replace"))
        terminal_verdict(gap)
        json_text(gap)
    elif name == "model.json":
        prepare_bench(model=path)
    elif name == "import":
        work = write_work(path.parent / "work", [])
        (path.parent / "bench").mkdir()
        path.rename(path.parent / "bench" / "run.csv")
        list(Importer(work, path.parent / "bench", observer=Notes()).watch(once=True))
        load_submission(work)


def try_seed(name: str, seed: int) -> None:
    """Damage a file at random and read it; expect a result or a short error.

    The error has one line, or in TOML one line per mistake.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(spoilt(name, Random(f"{name} {seed}")))
        most = MOST_LISTED + 1 if name == "plan.toml" else 1
        with few_lines_at_most(most) if name != "rubric.toml" else suppress(ConfigError):
            use(name, path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "seeds", [pytest.param(range(30), marks=pytest.mark.sample), range(30, 3_000)], ids=len
)
@pytest.mark.parametrize("name", NAMES)
def test_a_spoilt_file_gives_a_result_or_a_short_error(name, seeds):
    """For random faults in each kind of file, there is a result or a short error."""
    for seed in seeds:
        try_seed(name, seed)
