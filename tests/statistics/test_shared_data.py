"""In classes that share one bench, no honest team is flagged, and copied files are found."""

from dataclasses import replace

import pytest

from pipeline.grading.gradings import Grading
from pipeline.grading.similarity.copies import find_copies
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.ingest.read import read_data
from pipeline.simulated.bench import COUNT
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from tests.helpers.bench_classes import BENCHES, USUAL_NOISE, move_class, read_class

COPIED = ("decay-1a", "step-2", "sine-04", "sweep")
COUNTS = (1 / 20, 1 / 50, 1 / 150, COUNT, 1 / 500)  # cm
LONG = [pytest.mark.slow, pytest.mark.sample]
SAMPLE = {
    ("throne-1dof", "saturation"),
    ("throne-2dof", "saturation"),
    ("throne-2dof", "backlash"),
    ("throne-3dof", "saturation"),
}


def member(name, records):
    return Grading(submission=name, authors=(f"s-{name}",), fingerprints=fingerprint(records))


@pytest.mark.parametrize(
    ("number", "bench"),
    [
        pytest.param(number, bench, marks=LONG if bench in SAMPLE else pytest.mark.slow)
        for number, bench in enumerate(BENCHES)
    ],
    ids=lambda x: "-".join(x) if isinstance(x, tuple) else "",
)
def test_copies_are_found_and_honest_teams_are_not_flagged(number, bench):
    """On each bench, twelve honest teams are not flagged, and four copied files are found.

    One of the four files may contain too little motion to show that it is a copy.
    """
    preset, effect = bench
    count = COUNT if bench in SAMPLE else COUNTS[number % len(COUNTS)]
    seeds = range(100 * number, 100 * number + 12)
    moved = move_class(preset, effect, seeds=seeds, count=count)
    for noise in (USUAL_NOISE, USUAL_NOISE / 5):
        teams = read_class(moved, seed=number, noise=noise)
        honest = [member(str(i), records) for i, records in enumerate(teams)]
        assert find_copies(honest) == {}

        copied = [replace(r, id=f"{r.id} mine") for r in teams[0] if r.id in COPIED]
        mixed = [*(r for r in teams[1] if r.id not in COPIED), *copied]
        found = find_copies([honest[0], member("1", mixed), *honest[2:]])
        assert set(found) == {"0", "1"}
        assert len(found["1"]) >= len(COPIED) - 1
        assert all(r.experiment == f"{r.other_experiment} mine" for r in found["1"])
        assert all(r.equal_rows > 0 for r in found["1"])


@pytest.mark.slow
@pytest.mark.sample
def test_teams_on_different_benches_are_not_flagged(tmp_path):
    """The rounding of a steady sine repeats itself on other benches too, and nobody is flagged."""
    class_ = []
    for seed, effect in (
        (930, "coulomb_friction:cart=1"), (931, "backlash"), (934, "actuator_lag"),
        (937, "saturation"), (938, "dead_zone"),
    ):  # fmt: skip
        folder = tmp_path / str(seed)
        bench = prepare_bench(preset="throne-3dof", hide=(effect,))
        write_submission(folder, bench, seed=seed)
        class_.append(member(str(seed), read_data(load_submission(folder)).records))
    assert find_copies(class_) == {}
