"""Disguised copies of recordings are found, and teams that share only a bench are not flagged."""

import json
import zlib
from dataclasses import replace

import numpy as np
import pytest

from pipeline.grading.gradings import Grading
from pipeline.grading.similarity import noise
from pipeline.grading.similarity.copies import find_copies, same_recordings
from pipeline.grading.similarity.fingerprints import fingerprint, unpack
from pipeline.grading.similarity.shared_flag import shared_flag
from pipeline.ingest.read import read_data
from pipeline.simulated.bench import COUNT, SimulatedBench
from pipeline.simulated.hidden import preset_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from tests.helpers.bench_classes import move_class, read_class
from tests.helpers.ucsd import write_two_cart_submission

LONG = [pytest.mark.slow, pytest.mark.sample]


def recorded(folder, bench: str | SimulatedBench = "throne-2dof", *, seeds):
    """Return the recordings of teams that used the same bench in the same way."""
    for seed in seeds:
        write_submission(folder / str(seed), bench, seed=seed, compact=True)
    return [read_data(load_submission(folder / str(seed))).records for seed in seeds]


@pytest.fixture(scope="module")
def teams(tmp_path_factory):
    """Return the recordings of six teams on one bench."""
    return recorded(tmp_path_factory.mktemp("teams"), seeds=range(6))


@pytest.fixture(scope="module")
def others(teams):
    """Return four more teams of the class that share nothing with anybody."""
    return [prints(f"other-{number}", records) for number, records in enumerate(teams[2:])]


def prints(name, records, authors=None):
    authors = authors or (f"s-{name}",)
    return Grading(submission=name, authors=authors, fingerprints=fingerprint(records))


def class_of(teams):
    """Return a class of numbered teams with these recordings."""
    return [prints(str(number), records) for number, records in enumerate(teams)]


def with_signals(record, change, **more):
    """Return the recording with its input, its reference and its carts changed in the same way."""
    signals = {name: getattr(record, name) for name in ("u", "reference", "y")}
    new = {name: None if x is None else change(x) for name, x in signals.items()}
    return replace(record, **{**new, **more})


def disguised(record, rng, *, noise=0.0, scale=1.0, keep=1.0, later=0.0):
    """Return a copy that is cut, shifted in time, rescaled and renamed, with noise (in counts)."""
    n = record.t.size
    start = int(rng.integers(0, round((1 - keep) * n) + 1))
    part = slice(start, start + round(keep * n))
    y = (np.array(record.y) + noise * COUNT * rng.standard_normal(record.y.shape)) * scale
    cut = with_signals(replace(record, y=y), lambda x: x[..., part], t=record.t[part] + later)
    return replace(cut, id=f"{record.id} mine")


@pytest.fixture(scope="module")
def quiet_teams(tmp_path_factory):
    """Return three teams' recordings on one bench, with encoders too fine to show rounding."""
    bench = replace(preset_bench("throne-2dof"), count=COUNT / 100)
    return recorded(tmp_path_factory.mktemp("quiet"), bench, seeds=range(3))


def rounded(records, *, count, seed):
    """Return recordings rounded to the given encoder step, each cart with a random zero.

    Closed-loop runs are omitted, because the controller would have read this encoder too.
    """
    rng = np.random.default_rng(seed)
    zeros = [rng.uniform(-2, 2, size=(record.y.shape[0], 1)) for record in records]
    step = {"resolution": np.full_like(records[0].resolution, count)}
    return [
        replace(record, y=count * np.round(record.y / count + zero), **step)
        for record, zero in zip(records, zeros, strict=True)
        if record.kind != "closed_loop"
    ]


def of_kind(records, kind):
    return next(record for record in records if record.kind == kind)


@pytest.mark.slow
@pytest.mark.sample
def test_honest_teams_on_one_bench_share_nothing(teams):
    """Teams that drive one bench with the same inputs are not flagged, as their noise differs."""
    assert find_copies(class_of(teams)) == {}


@pytest.mark.parametrize(
    "per_cm", [5, 100, *(pytest.param(per_cm, marks=LONG) for per_cm in (20, 37, 500))]
)
def test_agreement_by_rounding_is_not_flagged(quiet_teams, per_cm):
    """If two noise-free recordings agree only because of rounding, nobody is flagged."""
    honest = [
        rounded(records, count=1 / per_cm, seed=seed) for seed, records in enumerate(quiet_teams)
    ]
    batch = class_of(honest)
    assert find_copies(batch) == {}
    rng = np.random.default_rng(4)
    if per_cm >= 100:  # with fewer steps per cm, a whole submission has too many zeros in common
        copied = [disguised(r, rng, keep=0.8, later=2.0) for r in honest[0]]
        assert set(find_copies([*batch, prints("copy", copied)])) == {"0", "copy"}


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("per_cm", [5, pytest.param(20, marks=LONG)])
def test_honest_teams_with_coarse_encoders_share_nothing(tmp_path, per_cm):
    """Honest teams with coarse encoders are not flagged, even if a cart moves by one or two counts.

    Under feedback, the input then has few levels too.
    """
    bench = replace(preset_bench("throne-2dof"), count=1 / per_cm, travel=0.3)
    assert find_copies(class_of(recorded(tmp_path, bench, seeds=(1, 2, 7)))) == {}


@pytest.mark.parametrize("kind", ["decay", "step", "sweep", "closed_loop"])
@pytest.mark.parametrize(
    "disguise", [{}, {"scale": -10.0, "later": 3.0}, {"scale": 1.07, "keep": 0.75}], ids=str
)
def test_a_disguised_copy_of_one_recording_is_found(teams, others, kind, disguise):
    """One copied recording is found among honest ones; each finding names the other submission."""
    rng = np.random.default_rng(7)
    copied = disguised(of_kind(teams[0], kind), rng, **disguise)
    found = find_copies([prints("a", teams[0]), prints("b", [*teams[1], copied]), *others])
    (mine,), (theirs,) = found["b"], found["a"]
    assert (mine.submission, mine.other_experiment) == ("a", theirs.experiment)
    assert (theirs.submission, theirs.other_experiment) == ("b", mine.experiment)
    assert mine.experiment == copied.id


def smoothed(records, rng, *, noise):
    """Return copies with noise in counts, smoothed over five samples."""
    mean = np.full(5, 0.2)
    copied = [disguised(r, rng, noise=noise) for r in records]
    return [replace(r, y=np.array([np.convolve(row, mean, "same") for row in r.y])) for r in copied]


def doubled(records):
    """Return copies with an interpolated sample between any two samples."""
    made = []
    for r in records:
        t = np.linspace(r.t[0], r.t[-1], 2 * r.t.size - 1)
        between = lambda x, r=r, t=t: np.apply_along_axis(lambda row: np.interp(t, r.t, row), -1, x)  # noqa: E731
        made.append(with_signals(r, between, t=t))
    return made


def mixed(records, others, *, fade):
    """Return the mean of two teams' recordings, or one that turns into the other."""
    made = []
    for one, other in zip(records, others, strict=True):
        n = min(one.t.size, other.t.size)
        share = np.linspace(1, 0, n) if fade else np.full(n, 0.5)
        y = share * one.y[:, :n] + (1 - share) * other.y[:, :n]
        made.append(with_signals(one, lambda x, n=n: x[..., :n], t=one.t[:n], y=y))
    return made


WHOLE = {
    "noise 0.3": lambda own, _, rng: [disguised(r, rng, noise=0.3) for r in own],
    "noise 1, cut, reversed": lambda own, _, rng: [
        disguised(r, rng, noise=1.0, scale=-2.54, keep=0.8) for r in own
    ],
    "noise 3, cut": lambda own, _, rng: [disguised(r, rng, noise=3.0, keep=0.8) for r in own],
    "noise 3, smoothed": lambda own, _, rng: smoothed(own, rng, noise=3.0),
    "noise 0.3, doubled": lambda own, _, rng: doubled([disguised(r, rng, noise=0.3) for r in own]),
    "blended": lambda own, other, _: mixed(own, other, fade=False),
    "cross-faded": lambda own, other, _: mixed(own, other, fade=True),
}


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(
    "disguise",
    [
        pytest.param(name, marks=() if name in ("noise 3, cut", "blended") else LONG)
        for name in WHOLE
    ],
)
def test_a_whole_copy_is_found_without_equal_rows(teams, others, disguise):
    """A copied submission is found by its noise and its releases, and nobody else is flagged.

    A mixture of two submissions is found beside both, and hides no other copy.
    """
    rng = np.random.default_rng(8)
    made = WHOLE[disguise](teams[0], teams[1], rng)
    found = find_copies([prints("a", teams[0]), prints("copy", made), *others])
    assert set(found) == {"a", "copy"}
    assert {record.submission for record in found["a"]} == {"copy"}
    if disguise in ("blended", "cross-faded"):
        again = [disguised(r, rng, noise=0.3) for r in teams[2]]  # a copy of the first other team
        batch = [prints("a", teams[0]), prints("b", teams[1]), prints("copy", made), *others]
        found = find_copies([*batch, prints("again", again)])
        assert {name: {r.submission for r in records} for name, records in found.items()} == {
            "a": {"copy"}, "b": {"copy"}, "copy": {"a", "b"},
            "again": {"other-0"}, "other-0": {"again"},
        }  # fmt: skip


def test_a_bench_that_releases_by_itself_proves_nothing(teams):
    """If a bench releases the carts of all teams in the same way, equal releases prove nothing."""
    rng = np.random.default_rng(3)
    window = np.hanning(11) / np.hanning(11).sum()
    smooth = {
        r.id: np.array([np.convolve(row, window, "same") for row in r.y])
        for r in teams[0]
        if r.kind == "decay"
    }

    def read(record):
        if record.id not in smooth:
            return record
        motion = smooth[record.id]
        like = next(r for r in teams[0] if r.id == record.id)
        noisy = motion + COUNT * rng.standard_normal(motion.shape)
        return replace(like, y=COUNT * np.round(noisy / COUNT))

    same = [[read(record) for record in records] for records in teams]
    assert find_copies(class_of(same)) == {}


def test_one_noisy_recording_proves_nothing(teams, others):
    """The noise of a single recording is no evidence, since a bench may repeat it."""
    rng = np.random.default_rng(7)
    copied = disguised(of_kind(teams[0], "sweep"), rng, noise=0.3)
    assert find_copies([prints("a", teams[0]), prints("b", [*teams[1], copied]), *others]) == {}


def test_teammates_and_repeats_are_not_flagged(teams):
    """Submissions with a common author are not flagged, nor is a recording submitted twice."""
    twice = [*teams[0], replace(of_kind(teams[0], "step"), id="again")]
    a = prints("a", twice, authors=("ann", "bob"))
    b = prints("b", teams[0], authors=("bob", "carl"))
    assert find_copies([a, b]) == {}


def test_recordings_that_were_handed_out_are_not_flagged(teams):
    """Recordings that the instructor handed out are not flagged; a copy of any other one is."""
    given, own = teams[0][:-1], teams[0][-1]
    example = fingerprint(given)
    batch = [prints("a", teams[0]), prints("b", [*teams[1][:3], *given])]
    assert find_copies(batch, examples=[example]) == {}
    batch.append(prints("c", [own]))
    found = find_copies(batch, examples=[example])
    assert {(name, r.experiment) for name in found for r in found[name]} == {
        ("a", own.id), ("c", own.id),
    }  # fmt: skip


def test_a_whole_class_may_use_a_handed_out_recording(teams):
    """However many teams submit a handed-out recording, none of the teams is flagged."""
    rng = np.random.default_rng(11)
    copies = [[disguised(r, rng, scale=2.0, later=1.0) for r in teams[0][:2]] for _ in range(20)]
    batch = [prints(f"t{number:02d}", records) for number, records in enumerate(copies)]
    assert len(find_copies(batch)) == 20
    assert find_copies(batch, examples=[fingerprint(teams[0][:2])]) == {}


def test_a_copy_from_an_earlier_batch_is_found(teams):
    """A recording from an earlier batch is found and named as such.

    Copies within the earlier batch are not reported again.
    """
    old = [prints("x", teams[0]), prints("y", teams[0])]
    found = find_copies([prints("a", teams[0][:4])], earlier=old)
    assert set(found) == {"a"}
    assert {r.submission for r in found["a"]} == {"x (an earlier batch)", "y (an earlier batch)"}
    flag = shared_flag(found["a"])
    assert flag.parameters == tuple(r.id for r in teams[0][:4])


@pytest.fixture
def compared(monkeypatch):
    """Return a list to which each comparison at one time shift adds its pair of recordings."""
    pairs, compare = [], noise.compare

    def counted(a, b, **how):
        pairs.append((a.experiment, b.experiment))
        return compare(a, b, **how)

    monkeypatch.setattr(noise, "compare", counted)
    return pairs


@pytest.mark.slow
@pytest.mark.sample
def test_a_recording_under_many_names_is_compared_once(teams, compared):
    """A file that two submissions list under a thousand names is compared only once."""
    record = of_kind(teams[0], "decay")
    many = [replace(record, id=f"decay-{number}") for number in range(1_000)]
    a, b = prints("a", many), prints("b", many)
    assert len(unpack(a.fingerprints)) == 1_000
    assert sum(one.residual.size for one in unpack(a.fingerprints)) <= 2_000_000
    found = find_copies([a, b])
    assert set(compared) == {("decay-0", "decay-0")}
    assert [r.experiment for r in found["a"]] == ["decay-0"]


@pytest.mark.parametrize("alike", ["cuts of one run", "one hum in all"])
def test_the_cost_grows_with_the_recordings_not_their_square(teams, alike, compared):
    """If all recordings look the same, at most ten comparisons per recording are needed."""
    rng = np.random.default_rng(5)
    record = of_kind(teams[0], "decay")
    if alike == "cuts of one run":
        made = lambda: disguised(record, rng, noise=0.01, keep=0.8)  # noqa: E731
    else:
        hum = np.resize(3 * COUNT * rng.standard_normal(37), record.t.size)
        made = lambda: disguised(replace(record, y=record.y + hum), rng, noise=1.0)  # noqa: E731
    batch = [prints(name, [replace(made(), id=str(k)) for k in range(50)]) for name in "ab"]
    find_copies(batch)
    assert 0 < len(compared) <= 10 * 100  # there would be 2,500 pairs, each with many time shifts


@pytest.mark.parametrize("kind", ["step", "decay"])
def test_repeats_on_a_real_bench_are_not_flagged(real_data, tmp_path, kind):
    """Repeats of one experiment on a real bench are not flagged as copies of each other."""
    folder = write_two_cart_submission(tmp_path / "s", real_data, steps=(1, 2, 3, 4, 5))
    records = [r for r in read_data(load_submission(folder)).records if r.kind == kind]
    teams = class_of([record] for record in records)
    assert find_copies(teams) == {}
    copy = disguised(records[2], np.random.default_rng(3), scale=0.5, keep=0.8)
    found = find_copies([*teams, prints("copy", [copy])])
    assert {r.submission for r in found["copy"]} == {"2"}


@pytest.fixture(scope="module")
def knocking():
    """Return eight teams on a bench with backlash, whose impacts are as sharp as noise."""
    moved = move_class("throne-1dof", "backlash", seeds=range(8), dwells=4)
    return read_class(moved, seed=3)


@pytest.mark.slow
@pytest.mark.sample
def test_the_impacts_of_a_bench_are_not_flagged(knocking):
    """Teams that share only a bench's impacts are not flagged; a noisy copy is still found.

    This also holds if two teams used this bench, and the others a bench without impacts.
    """
    honest = class_of(knocking)
    assert find_copies(honest) == {}
    rng = np.random.default_rng(1)
    copied = [disguised(r, rng, noise=0.5) for r in knocking[0]]
    assert set(find_copies([honest[0], prints("1", copied), *honest[2:]])) == {"0", "1"}
    quiet = read_class(move_class("throne-1dof", seeds=range(20, 26), dwells=4), seed=4)
    two = [prints(f"quiet-{number}", records) for number, records in enumerate(quiet)]
    assert find_copies([*honest[:2], *two]) == {}


@pytest.mark.parametrize("members", [2, 3])
def test_in_a_small_class_only_equal_rows_are_flagged(teams, members):
    """In a class of two or three teams, a copy is flagged only if its rows are equal.

    So few teams cannot rule out that equal noise comes from the bench.
    """
    rng = np.random.default_rng(2)
    record = of_kind(teams[0], "step")
    others = [prints(str(number), teams[number]) for number in range(2, members)]
    for counts, told in ((0.0, {"a", "b"}), (0.4, set())):
        copied = disguised(record, rng, noise=counts, keep=0.8, later=2.0)
        b = prints("b", [*teams[1], copied])
        assert set(find_copies([prints("a", teams[0]), b, *others])) == told


def test_three_equal_copies_among_six_teams_are_flagged(teams):
    """If three of six teams have the same copy, all three are flagged.

    The copies do not count as evidence that the noise comes from the bench.
    """
    record = of_kind(teams[0], "step")
    rest = [prints(str(number), teams[number]) for number in range(3, 6)]
    rng = np.random.default_rng(4)
    copies = [prints(f"copy-{n}", [*teams[n], disguised(record, rng, noise=0.0)]) for n in (1, 2)]
    found = find_copies([prints("a", teams[0]), *copies, *rest])
    assert {name: len(found[name]) for name in found} == {"a": 2, "copy-1": 2, "copy-2": 2}


def test_a_flag_says_which_rows_are_equal(teams):
    """The flag's evidence and message say how many rows are equal, and at which times."""
    copied = disguised(of_kind(teams[0], "step"), np.random.default_rng(6), scale=10.0, later=3.0)
    (record,) = find_copies([prints("a", teams[0]), prints("b", [copied])])["b"]
    (evidence,) = shared_flag([record]).evidence["recordings"]
    first, last = evidence["time"]
    rows = (copied.t >= first - 0.001) & (copied.t <= last + 0.001)
    assert evidence["equal_rows"] == np.count_nonzero(rows)
    assert evidence["other_time"] == pytest.approx((first - 3.0, last - 3.0))
    said = shared_flag([record]).message
    assert f"{evidence['equal_rows']} " in said
    assert f"{first:g} s to {last:g} s" in said


def test_fingerprints_of_an_older_version_are_not_compared(teams):
    """Fingerprints of an older version are ignored, because they lack what is compared now."""
    head = {"experiment": "step-1", "group": "step 1,2 ", "shape": [2, 3], "step": [1, 1]}
    old = zlib.compress(json.dumps([head | {"anchors": [], "swing": []}]).encode() + bytes(7))
    assert unpack(old) == ()
    before = Grading(submission="a", authors=("ann",), fingerprints=old)
    assert not same_recordings(before, prints("a", teams[0][:1]))
    assert find_copies([prints("a", teams[0][:1])], earlier=[before]) == {}


def test_still_or_short_recordings_have_no_fingerprint(teams):
    """A recording that is too short or has no motion gets no fingerprint."""
    record = of_kind(teams[0], "step")
    still = replace(record, y=np.zeros_like(record.y))
    short = replace(record, t=record.t[:50], u=record.u[:50], y=record.y[:, :50])
    assert fingerprint([still, short]) == b""
    (kept,) = unpack(fingerprint([still, record]))
    assert kept.experiment == record.id
    assert kept.residual.shape == (2, record.t.size - 40)
