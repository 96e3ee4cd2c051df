"""Whatever is wrong in a student's data, analysis ends in a result or in one line of error."""

import csv
import json
import tempfile
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.arrays import Array
from pipeline.errors import PipelineError
from pipeline.json_files import json_text
from pipeline.resources import EXAMPLES
from pipeline.submission import Experiment, Submission, load_submission
from pipeline.workflow import analyse

KINDS = ("decay", "step", "sine", "sweep", "closed_loop")
MOST_RUNS = 6  # at most this many runs of each kind; more would only cost time


def stuck(y: Array) -> Array:
    """Keep the channel constant after a third of the record."""
    return np.where(np.arange(y.size) < y.size // 3, y, y[y.size // 3])


def jumping(y: Array) -> Array:
    """Add a jump of a thousand units halfway through the record."""
    return y + 1e3 * (np.arange(y.size) >= y.size // 2)


def spiked(y: Array) -> Array:
    """Replace the channel by zeros with one spike."""
    return np.eye(1, y.size, y.size // 2)[0]


def clipped(y: Array) -> Array:
    """Clip the channel at a tenth of its largest value."""
    return np.clip(y, -0.1 * np.abs(y).max(), 0.1 * np.abs(y).max())


def noisy(y: Array) -> Array:
    """Replace the channel by noise."""
    return np.random.default_rng(y.size).standard_normal(y.size)


CHANNELS = {
    "dead": lambda y: 0 * y,
    "constant": lambda y: 0 * y + 3.3,
    "stuck": stuck,
    "jumping": jumping,
    "spiked": spiked,
    "clipped": clipped,
    "noisy": noisy,
    "reversed": lambda y: y[::-1],
    "negated": lambda y: -y,
    "offset": lambda y: y + 1e6,
    "ramp": lambda y: np.arange(y.size, dtype=float),
    "huge": lambda y: 1e40 * y,
    "large": lambda y: 1e6 * y,
    "small": lambda y: 1e-6 * y,
    "tiny": lambda y: 1e-40 * y,
}
LENGTHS = {"whole": slice(None), "first": slice(8), "short": slice(40), "half": slice(0, None, 2)}


@dataclass(frozen=True, eq=False)
class Case:
    """A submission, the header and values of each of its files, and a list of what was changed."""

    submission: Submission = field(repr=False)
    files: dict[str, tuple[str, Array]] = field(repr=False)
    changes: tuple[str, ...]


@cache
def example(name: str) -> tuple[Submission, dict[str, tuple[list[str], Array]]]:
    """Load an example and the table of each of its files."""
    submission = load_submission(EXAMPLES / name)
    tables = {}
    for experiment in submission.experiments:
        with (EXAMPLES / name / experiment.file).open(encoding="utf-8", newline="") as file:
            header, *rows = csv.reader(file)
        tables[experiment.file] = header, np.array(rows, dtype=float)
    return submission, tables


@st.composite
def broken(draw: st.DrawFn, names: list[str]) -> Case:
    """Draw an example with missing kinds, damaged channels, and wrongly declared experiments."""
    name = draw(st.sampled_from(names))
    submission, tables = example(name)
    system = submission.system
    kinds = draw(st.sets(st.sampled_from(KINDS), min_size=1, max_size=3))
    all_spoilt = draw(st.booleans())
    experiments, files, changes = [], {}, [name]
    for kind in sorted(kinds):
        runs = [e for e in submission.experiments if e.kind == kind]
        for run in runs[:: max(len(runs) // MOST_RUNS, 1)]:
            header, values = tables[run.file]
            done: list[str] = []
            if all_spoilt or draw(st.booleans()):
                values, done = spoil(draw, header, values)
            if draw(st.integers(0, 9)) == 0:
                run = mislabelled(draw, run, system.carts)
                done.append(f"called a {run.kind} of {run.carts}")
            experiments.append(run)
            files[run.file] = ",".join(header), values
            changes.append(f"{run.id}: {', '.join(done) or 'as it was'}")
    if draw(st.integers(0, 4)) == 0:
        count = system.carts + 1
        springs = tuple(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
        system = system.model_copy(update={"springs": springs})
        changes.append(f"springs {springs}")
    update = {"experiments": tuple(experiments), "system": system}
    return Case(submission.model_copy(update=update), files, tuple(changes))


def spoil(draw: st.DrawFn, header: list[str], values: Array) -> tuple[Array, list[str]]:
    """Damage one or two columns other than the time, or cut the record."""
    values, done = values.copy(), []
    for _ in range(draw(st.integers(1, 2))):
        column = draw(st.integers(1, len(header) - 1))
        how = draw(st.sampled_from(sorted(CHANNELS)))
        values[:, column] = CHANNELS[how](values[:, column])
        done.append(f"{header[column]} {how}")
    if draw(st.integers(0, 4)) == 0:
        order = [0, *draw(st.permutations(range(1, len(header))))]
        values = values[:, order]
        done.append(f"columns {order}")
    length = draw(st.sampled_from(["whole", "whole", "whole", *LENGTHS]))
    return values[LENGTHS[length]], [*done, length]


def mislabelled(draw: st.DrawFn, run: Experiment, n: int) -> Experiment:
    """Declare a wrong kind of experiment, or the wrong free carts."""
    if draw(st.booleans()):
        return run.model_copy(update={"kind": draw(st.sampled_from(KINDS))})
    carts = draw(st.sets(st.integers(1, n), min_size=1))
    return run.model_copy(update={"carts": tuple(sorted(carts))})


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is not JSON")


def check(case: Case) -> None:
    """Analyse the case, and expect valid JSON or a PipelineError of one line."""
    with tempfile.TemporaryDirectory() as folder:
        for name, (header, values) in case.files.items():
            path = Path(folder) / name
            path.parent.mkdir(exist_ok=True)
            np.savetxt(path, values, delimiter=",", header=header, comments="", fmt="%.9g")
        try:
            analysis = analyse(case.submission.model_copy(update={"folder": Path(folder)}))
        except PipelineError as error:
            if "\n" in str(error):
                raise
            return
    json.loads(json_text(analysis), parse_constant=refuse)


quick = settings(max_examples=3, deadline=None, suppress_health_check=[HealthCheck.data_too_large])


@quick
@given(broken(["one-cart", "two-cart"]))
def test_broken_data_give_a_result_or_one_line(case):
    """Whatever is wrong with the channels, `analyse` returns a result or one line of error."""
    check(case)


@pytest.mark.slow
@settings(quick, max_examples=400)
@given(broken(["one-cart", "two-cart", "three-cart"]))
def test_broken_data_of_up_to_three_carts_give_a_result_or_one_line(case):
    """In many more cases, broken data of up to three carts give a result or one line of error."""
    check(case)
