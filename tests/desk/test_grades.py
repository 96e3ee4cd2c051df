"""Without scripts, the TA's pages show the class and its teams, and change, import and export."""

import io
import re
import shutil
import zipfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from html import unescape
from itertools import chain
from threading import Barrier
from urllib.parse import quote, urlencode, urlsplit

import pytest

from pipeline.desk.app import DeskServer
from pipeline.desk.gradebooks import ClassView
from pipeline.grading.grade import Flag
from pipeline.grading.gradebook.events import Event
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from pipeline.grading.intake.repairs import Run, read_run, save_run
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.export import export, export_feedback
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.total import point_steps
from pipeline.resources import RUBRICS
from pipeline.words.text import capital
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import (
    Answer,
    Visitor,
    a_submission,
    at_desk,
    through_proxy,
    write_users,
)
from tests.helpers.grades import (
    book_of,
    fill_book,
    make_grade,
    make_outcome,
    two_cart_rubric,
    write_class,
)
from tests.helpers.grading_students import criterion, write_team
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("all_work_here")
ROOM = "/grades/0/"


@pytest.fixture
def grades(tmp_path):
    """Write the output of grading a class."""
    return write_class(tmp_path / "grades")


@pytest.fixture
def ta(grades):
    """Return a TA at this computer."""
    with at_desk(opened=grades) as visitor:
        visitor.post(at("team-01"), do="sign", by="Ada")
        yield visitor


def overrides(grades, team: str = "team-01") -> Mapping[str, Event]:
    """Return what was changed by hand for a team."""
    with Gradebook(grades) as book:
        return book.entry(team).overrides


def put(folder, *outcomes) -> None:
    """Write a class of these outcomes."""
    with Gradebook(folder, assignment="lab", create=True) as book:
        for outcome in outcomes:
            book.put(outcome)
        batch = Batch(keys=tuple(outcome.key for outcome in outcomes), shared={})
        book.finish(batch, rubric=two_cart_rubric())


def names(answer: Answer) -> list[str]:
    """Return the submissions listed on a page of the class."""
    assert answer.status == 200, answer.text
    return [unescape(n) for n in re.findall(r'<th scope="row"><a [^>]*>(.*?)</a>', answer.text)]


def at(team: str, **more: str) -> str:
    """Return the address of a team's page."""
    return f"{ROOM}team?{urlencode({'of': team, **more})}"


def version(answer: Answer, criterion: str) -> str:
    """Return the version of a criterion that a page shows."""
    found = re.search(rf'value="{criterion}"><input type="hidden" name="seen" value="(.*?)"',
                      answer.text)  # fmt: skip
    assert found
    return found[1]


def change(who: Visitor, team: str, criterion: str = "laws", seen: str = "", **fields: str):
    """Send the form of a criterion."""
    seen = seen or version(who.get(at(team, criterion=criterion)), criterion)
    return who.post(at(team), do="change", criterion=criterion, seen=seen, **fields)


def upload(who: Visitor, path: str, name: str, content: str, **fields: str) -> Answer:
    """Send a form with a file in it."""
    return who.upload(path, [("t.csv", content.encode())], name=name, **fields)


# ---------------------------------------------------------------------------- the class


def test_a_class_is_filtered_and_its_lines_are_its_grades(ta, grades):
    """Each filter shows the teams that meet it in the gradebook; filters can be combined.

    Each line of the class page equals its team's grade; only changed lines are made again.
    """
    with Gradebook(grades) as book:
        entries = {entry.submission: entry for entry in book.entries()}
    ta.post(at("team-03"), do="accept")

    def those(test) -> set[str]:
        return {name for name, entry in entries.items() if test(entry)}

    codes = {name: [f.code for f in entry.grade.flags] for name, entry in entries.items()}
    lost = those(lambda e: any(c.id == "laws" and c.points < c.out_of for c in e.grade.criteria))
    for query, expected in {
        "": set(entries),
        "flag=hz_for_rad_s": {name for name, own in codes.items() if "hz_for_rad_s" in own},
        "flag=shared_data": {"team-02", "team-03"},
        "state=failed": {"broken"},
        "state=late": those(lambda e: e.grade.days_late > 0),
        "state=hand": {"team-02"},
        "seen=yes": {"team-03"},
        "seen=no": set(entries) - {"team-03"},
        "lost=laws": lost,  # only graded teams
        "lost=laws&flag=shared_data&seen=no": {"team-02"} & lost,
        "q=S4": {"team-05"},
        "q=ünal": {"Ünal 学生 & co"},
        "flag=nothing": set(),
    }.items():
        assert set(names(ta.get(f"{ROOM}?{quote(query, safe='=&')}"))) == expected, query
    by_points = names(ta.get(ROOM + "?order=points"))
    assert [entries[n].grade.points for n in by_points] == sorted(
        entry.grade.points for entry in entries.values()
    )

    with Gradebook(grades) as book:
        first = book.class_now()
        assert first.entries == list(book.entries())
        book.override("team-03", "laws", 0.25, why="x", by="y")
        second = book.class_now(first)
        assert second.entries == list(book.entries())
        same = [a is b for a, b in zip(first.entries, second.entries, strict=True)]
        assert same.count(False) == 1


def test_a_large_class_comes_a_page_at_a_time(tmp_path):
    """In a class of several pages, every team is on exactly one page."""
    outcomes = [make_outcome(make_grade(f"t{n:03d}")) for n in range(120)]
    put(tmp_path, *outcomes)
    with at_desk(opened=tmp_path) as who:
        shown = [names(who.get(f"{ROOM}?page={page}")) for page in ("1", "2", "3")]
        assert [len(page) for page in shown] == [50, 50, 20]
        assert list(chain(*shown)) == [outcome.submission for outcome in outcomes]
        for odd in ("0", "-1", "9" * 40, "x", "4"):
            assert names(who.get(f"{ROOM}?page={odd}"))


def test_the_order_of_hidden_names_tells_nothing(tmp_path):
    """The `teams` of an anonymous class come in the order of their pseudonyms."""
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        outcomes = [make_outcome(make_grade(f"t{n:02d}")) for n in range(12)]
        for outcome in outcomes:
            book.put(outcome)
        rubric = two_cart_rubric().model_copy(update={"anonymous": True})
        book.finish(Batch(keys=tuple(one.key for one in outcomes), shared={}), rubric=rubric)
        teams = ClassView(book.class_now(), book.state()).teams
    assert len(teams) == 12
    assert list(teams) == sorted(teams)
    assert all(name.startswith("anon-") for name in teams)


def test_each_criterion_shows_its_recordings(tmp_path):
    """Each criterion shows the recording of its number; other recordings are listed apart.

    If a criterion has two figures, that of the number with the largest error comes first, and the
    other one is one click away.
    """
    drawn = ("record-K_1", "record-omega_2-zeta_2", "response-1", "response-2", "other")
    found = {"initial-gains": {"K_1": 3.0}, "initial-decays": {"zeta_2": 0.1},
             "final-gains": {"K_1": 25.0, "K_2": 8.0}}  # fmt: skip
    grade = make_grade("team", share=0.5)
    criteria = tuple(
        c.model_copy(update={"found": found.get(c.id, {}), "expected": {"K_1": 24.0, "K_2": 16.0}})
        for c in grade.criteria
    )
    figures = tuple((f"{n}.svg", f"<svg><title>{n}</title></svg>") for n in drawn)
    put(tmp_path, make_outcome(grade.model_copy(update={"criteria": criteria}), figures=figures))
    with at_desk(tmp_path) as who:
        shown = {}
        for asked in two_cart_rubric().criteria:
            page = unescape(who.get(at("team", criterion=asked.id)).text)
            beside, _, rest = page.partition('id="evidence"')
            shown[asked.id] = re.findall('figure=([^"&]*?).svg"><img', beside)
            assert "figure=other.svg" in rest
        page = who.get(at("team", criterion="final-gains")).text
        other = re.search(r'<a class="button" href="([^"]*figure=response-1[^"]*)"', page)
        assert other
        after = who.get(unescape(other[1]).partition("#")[0]).text
    assert {key: figures[:1] for key, figures in shown.items() if figures} == {
        "initial-gains": ["record-K_1"], "initial-decays": ["record-omega_2-zeta_2"],
        "final-gains": ["response-2"], "final-frequencies": ["response-1"],
        "final-dampings": ["response-1"],
    }  # fmt: skip
    assert re.findall(r'<img class="drawing" src="[^"]*figure=(.*?).svg"', after)[0] == "response-1"


def test_pages_show_the_current_gradebook(ta, grades):
    """Histogram, class page and feedback are drawn from the current gradebook, not from files."""
    before = ta.get(ROOM + "class.html").text
    picture = ta.get(ROOM + "distribution.svg")
    assert picture.headers["content-type"].startswith("image/svg+xml")
    assert "sandbox" in picture.headers["content-security-policy"]
    assert change(ta, "team-09", points="0", why="not theirs").status == 303
    assert ta.get(ROOM + "class.html").text != before
    address = quote("feedback/team-09/feedback.html")
    assert "not theirs" in ta.get(ROOM + address).text
    assert "not theirs" not in (grades / "feedback/team-09/feedback.html").read_text("utf-8")
    ta.post(ROOM + "publish")
    until(lambda: "Writing: done" in ta.get(ROOM).text)
    assert "not theirs" in (grades / "feedback/team-09/feedback.html").read_text("utf-8")


# ------------------------------------------------------------------------------- a team


def test_reported_and_recomputed_numbers_are_shown(ta):
    """A team's page shows reported and recomputed numbers, the flag's evidence and the figure.

    Hostile text appears as plain text.
    """
    page = ta.get(at("team-01")).text
    assert "3.12" in page
    assert "19.6" in page
    remark = page.split('id="remarks"')[1].split("</section>")[0]
    assert re.findall(r"<th [^>]*>(.*?)</th>", remark) == ["Reported", "Recomputed", "Ratio"]
    page = ta.get(at("team-01", criterion="final-gains")).text
    figure = re.search(r'<img class="drawing" src="(.*?)"', page)
    assert figure
    drawn = ta.get(unescape(figure[1]))
    assert drawn.status == 200
    assert drawn.text.startswith("<svg")
    assert "<script" not in ta.get(at("team-05")).text.split("<main")[1]
    assert "&lt;script&gt;" in ta.get(at("team-05")).text
    assert "&lt;b&gt;cart" in ta.get(at("broken")).text
    assert ta.get(at("team-99")).status == 404
    assert ta.get(f"{ROOM}figure?of=team-01&figure=../x").status == 404


def test_criteria_that_lost_points_come_first(ta):
    """Criteria that lost the most points come first; those with all points take one line each.

    Any criterion can be chosen.
    """
    with_all = ta.get(at("a-name-without-end-" * 5)).text
    titles = {asked.id: asked.title for asked in two_cart_rubric().criteria}
    assert "To look at" in with_all
    assert change(ta, "team-01", "final-gains", points="1", why="two are swapped").status == 303

    def listed_in(part: str, page: str) -> list[str]:
        section = page.split(f'id="{part}-title"')[1].split("</section>")[0]
        return re.findall(r"criterion=([\w-]+)", section)

    passed = listed_in("passed", ta.get(at("team-01")).text)
    doubts = listed_in("doubts", ta.get(at("team-01")).text)
    assert doubts == ["data", "final-gains"]  # one has a flag, one was changed by hand
    assert {*passed, *doubts} == set(titles)
    page = ta.get(at("team-06")).text
    order = listed_in("doubts", page)
    lost = {asked.id: asked.points for asked in two_cart_rubric().criteria}
    assert [lost[one] for one in order] == sorted((lost[one] for one in order), reverse=True)
    chosen = re.search(r'id="chosen-title">(.*): ', page)
    assert chosen
    assert chosen[1].lower() == titles[order[0]].lower()
    for asked in order:
        own = ta.get(at("team-06", criterion=asked)).text
        assert f'name="criterion" value="{asked}"' in own
        assert own.count('aria-current="true"') == 1


@pytest.mark.parametrize(
    ("out_of", "step", "steps"),
    [
        (1.0, 0.25, [0, 0.25, 0.5, 0.75, 1]), (2.0, 0.25, [n / 4 for n in range(9)]),
        (5.0, 0.25, [0, 1.25, 2.5, 3.75, 5]), (1.0, 0.01, [0, 0.25, 0.5, 0.75, 1]),
        (1.5, 1.0, [0, 1, 1.5]), (3.0, 0.5, [n / 2 for n in range(7)]), (0.1, 0.25, [0, 0.1]),
    ],
)  # fmt: skip
def test_points_come_in_steps_of_the_rubric(out_of, step, steps):
    """Keys give points in the rubric's steps, or in quarters if there are too many steps."""
    assert point_steps(out_of, step=step) == steps


def test_points_are_changed_as_by_the_command(ta, grades):
    """Points can be changed with a reason and undone, and the history lists every change."""
    assert change(ta, "team-01", points="0,5", why="a clear plot").status == 303
    given = overrides(grades)["laws"]
    assert (given.points, given.text, given.by) == (0.5, "a clear plot", "Ada")
    assert given.text in ta.get(at("team-01")).text
    for expected in ({}, {"laws": 0.5}):  # undo the change, then undo that
        seen = version(ta.get(at("team-01", criterion="laws")), "laws")
        ta.post(at("team-01"), do="undo", criterion="laws", seen=seen)
        assert {key: one.points for key, one in overrides(grades).items()} == expected
        with Gradebook(grades) as book:
            assert len(book.history("team-01")[1]) >= 4
    assert change(ta, "team-01", points="auto", why="as graded").status == 303
    assert not overrides(grades)


def test_forms_that_make_no_sense_change_nothing(ta, grades):
    """A form with points that are not allowed is refused at its field, a forged one at once.

    The same holds for an export to an unknown platform, a wrong roster and a regrade of nothing.
    """
    for points, why in (("1", " "), ("99", "x"), ("-1", "x"), ("nan", "x"), ("many", "x")):
        answer = change(ta, "team-01", points=points, why=why)
        assert answer.status == 422
        assert f'value="{points}"' in answer.text
        assert 'id="wrong-laws"' in answer.text
    seen = version(ta.get(at("team-01", criterion="laws")), "laws")
    for form in ({"do": "drop"}, {"do": "change", "criterion": "x", "seen": seen, "points": "1"},
                 {"do": "change", "criterion": "laws", "points": "1", "why": "x"},
                 {"do": "undo", "criterion": "laws", "seen": seen}):  # fmt: skip
        assert ta.post(at("team-01"), **form).status in (400, 409, 422), form
    assert upload(ta, ROOM + "export", "roster", "a,b\n1,2\n", lms="canvas").status == 422
    assert ta.post(ROOM + "export", lms="blackboard").status == 400
    assert ta.post(ROOM + "grade", paths="", rubric="x").status == 422
    change(ta, "team-02", points="0.5", why="alone")
    for moment in ("", "2026-01-01", "%"):  # times at which no decision was made in this class
        assert ta.post(ROOM + "bulk-change", do="undo", set=moment).status == 404
    assert overrides(grades, "team-02")["laws"].points == 0.5
    assert not overrides(grades)


def test_accept_opens_the_next_team_of_the_filter(ta):
    """After a team is accepted, the next unreviewed team of the filter is shown.

    After the last team the class is shown. The "reviewed" mark can be removed again.
    """
    query = {"flag": "hz_for_rad_s", "seen": "no"}
    expected = names(ta.get(f"{ROOM}?{urlencode(query)}"))
    address, visited = at(expected[0], **query), []
    while "team?" in address:
        page = ta.get(address)
        assert page.status == 200
        visited.append(re.findall(r"<h1>(.*?)</h1>", page.text)[0])
        address = ta.post(address, do="accept").headers["location"]
    assert [unescape(name) for name in visited] == expected
    assert address == f"{ROOM}?{urlencode(query)}"
    assert names(ta.get(address)) == []
    ta.post(at(expected[0], **query), do="unsee")
    assert names(ta.get(address)) == expected[:1]


def test_a_team_is_accepted_only_as_it_was_seen(ta, grades):
    """If somebody changed the team since its page was shown, it is looked at again."""
    version = ta.get(at("team-01")).value("version")
    with Gradebook(grades) as book:
        book.override("team-01", "laws", 0.5, why="x", by="Bob")
    answer = ta.post(at("team-01"), do="accept", version=version)
    assert "of=team-01" in answer.headers["location"]
    page = ta.get(answer.headers["location"])
    assert "Look again." in page.text
    with Gradebook(grades) as book:
        assert book.entry("team-01").reviewed_by == ""
    ta.post(at("team-01"), do="accept", version=page.value("version"))
    with Gradebook(grades) as book:
        assert book.entry("team-01").reviewed_by == "Ada"


def test_what_needs_a_look_comes_first(ta, grades):
    """The class starts with the teams to review: those in doubt, then those with few points."""
    with Gradebook(grades) as book:
        teams = {entry.submission: entry.grade for entry in book.entries()}
    ta.post(at("broken"), do="accept")
    shown = names(ta.get(ROOM))
    doubts = {name for name, grade in teams.items() if grade.flags or grade.status == "failed"}
    expected = sorted(teams, key=lambda n: (n == "broken", n not in doubts, teams[n].points))
    assert [(n in doubts, teams[n].points) for n in shown] == [
        (n in doubts, teams[n].points) for n in expected
    ]
    assert f"Continue with {shown[0]}" in unescape(ta.get(ROOM).text)
    second = ta.post(at(shown[0]), do="accept").headers["location"]
    assert urlencode({"of": shown[1]}) in second
    last = ta.post(at(shown[-1]), do="accept").headers["location"]
    assert urlencode({"of": shown[1]}) in last  # those that were passed over are not forgotten


def test_the_head_of_a_team_says_how_late_it_was(ta):
    """The days late and the points deducted for them stand next to the points."""
    pages = [ta.get(at(team)).text for team in ("team-04", "team-03")]
    heads = [re.findall(r'class="result">(.*?)<', page)[0] for page in pages]
    assert ["1 day late" in head for head in heads] == [True, False]


def test_teams_without_a_remark_are_accepted_together(ta, grades):
    """One look at their list is enough; a team that changed meanwhile is looked at again."""
    with Gradebook(grades) as book:
        clean = [
            e.submission for e in book.entries() if e.grade.status == "graded" and not e.grade.flags
        ]
    page = ta.get(ROOM + "clean")
    listed = re.findall(r'name="team" value="(.*?)" checked', page.text)
    assert sorted(map(unescape, listed)) == sorted(clean)
    changed, left, *_ = clean
    change(ta, changed, points="0.5", why="seen by another person")
    form = sent(page, *(name for name in clean if name != left))
    assert apply(ta, ROOM + "clean", form).status == 303
    assert "1 team changed" in ta.get(ROOM).text
    with Gradebook(grades) as book:
        by = {entry.submission: entry.reviewed_by for entry in book.entries()}
    assert {name for name, who in by.items() if who} == set(clean) - {changed, left}
    assert apply(ta, ROOM + "clean", sent(page, "nobody")).status == 422
    assert apply(ta, ROOM + "clean", sent(page)).status == 422


def test_earlier_reasons_are_offered(ta):
    """The page offers reasons given before for the same criterion, the most common first."""
    for team, why in (("team-05", "b"), ("team-06", "a"), ("team-07", "b")):
        change(ta, team, points="1", why=why)
    page = ta.get(at("team-08", criterion="laws")).text
    offered = re.search(r'<datalist id="reasons">(.*?)</datalist>', page)
    assert offered
    assert re.findall('value="(.*?)"', offered[1])[:2] == ["b", "a"]


# ------------------------------------------------------------------------- several at once


@pytest.fixture(scope="module")
def database():
    """Start a PostgreSQL server with a class in it."""
    from tests.helpers import postgres

    if why := postgres.missing():
        pytest.skip(why)
    with postgres.running() as url:
        fill_book(url)
        yield url


@pytest.fixture
def two_desks(database, tmp_path):
    """Start two desks on one database; return a visitor at each."""
    users = "".join(
        f'[[users]]\nname = "{name}"\nrole = "{role}"\ngradebooks = ["{database}"]\n'
        for name, role in (("Ada", "ta"), ("Bob", "ta"))
    )
    path = write_users(tmp_path, users + '[[users]]\nname = "Eve"\nrole = "student"\n')
    with DeskServer(users=path) as one, DeskServer(users=path) as other:

        def who(name: str, server: DeskServer) -> Visitor:
            return through_proxy(urlsplit(server.url).port or 0, name)

        yield who("Ada", one), who("Bob", other), who("Eve", one)


def test_the_second_of_two_changes_is_refused(two_desks, database):
    """If two TAs change the same points, the second sees both versions and changes nothing."""
    ada, bob, eve = two_desks
    seen = version(bob.get(at("team-04", criterion="laws")), "laws")
    since = re.search(r"since=(\d+)", bob.get(at("team-04")).text)
    assert since
    assert change(ada, "team-04", points="1", why="ada's reason", by="Mallory").status == 303
    answer = change(bob, "team-04", seen=seen, points="2", why="bob's reason")
    assert answer.status == 409
    for text in ("ada&#39;s reason", "bob&#39;s reason", "Ada", "Bob"):
        assert text in answer.text
    news = bob.get(f"{ROOM}news?since={since[1]}&told={since[1]}&of=team-04")
    assert "ada&#39;s reason" in news.text
    assert "hx-reswap" not in news.headers
    told = re.search(r"told=(\d+)", news.text)
    assert told
    again = bob.get(f"{ROOM}news?since={since[1]}&told={told[1]}&of=team-04")
    assert again.headers["hx-reswap"] == "none"
    with Gradebook(database) as book:
        given = book.entry("team-04").overrides["laws"]
        assert (given.points, given.by) == (1.0, "Ada")  # the user whom the proxy named
    assert eve.get(ROOM).status == 403  # students see no class, whatever the list says
    assert eve.post(at("team-04"), do="accept").status == 403
    assert database not in ada.get(ROOM).text


def test_only_one_of_two_simultaneous_changes_counts(two_desks, database):
    """If two changes are sent from the same page at one moment, one counts and one is refused."""
    ada, bob, _ = two_desks
    for number in range(20):
        seen = version(ada.get(at("team-06", criterion="pieces")), "pieces")
        ready = Barrier(2)

        def give(who, why, *, seen=seen, ready=ready):
            ready.wait()
            return change(who, "team-06", "pieces", seen=seen, points="0.5", why=why).status

        with ThreadPoolExecutor(2) as pool:
            one = pool.submit(give, ada, f"a{number}")
            other = pool.submit(give, bob, f"b{number}")
            assert sorted([one.result(), other.result()]) == [303, 409]
    with Gradebook(database) as book:
        assert len([o for _, o in book.changes_since(0) if o.criterion == "pieces"]) == 20


def test_a_submission_without_a_grade_can_be_taken_off_the_list(ta, grades):
    """A submission that could not be graded can leave the class list; one with a grade cannot."""
    assert 'value="remove"' in ta.get(at("broken")).text
    assert 'value="remove"' not in ta.get(at("team-01")).text
    assert ta.post(at("team-01"), do="remove").status == 400
    assert ta.post(at("broken"), do="remove").status == 303
    with Gradebook(grades) as book:
        left = {entry.submission for entry in book.entries()}
        assert [event.what for event in book.history("broken")[1]][-1] == "removed"
    assert ("team-01" in left, "broken" in left) == (True, False)
    assert ta.get(at("broken")).status == 404


# ------------------------------------------------------------------------------ in and out


def test_a_table_is_imported_whole_or_not_at_all(ta, grades):
    """A table of points is imported only if every line is right; a wrong line is named.

    Importing the same table again adds nothing.
    """
    head = "submission,criterion,points,why\n"
    good = 'team-01,laws,1,"clear, at last"\nÜnal 学生 & co,pieces,0.5,late\n'
    for wrong in ("team-99,laws,1,x\n", "team-01,nothing,1,x\n", "team-01,laws,77,x\n",
                  "team-01,laws,?,x\n", "team-01,laws,1,\n"):  # fmt: skip
        answer = upload(ta, ROOM + "import", "table", head + good + wrong)
        assert (answer.status, "line 4" in answer.text) == (422, True)
        assert not overrides(grades)
    assert upload(ta, ROOM + "import", "table", "a,b\n1,2\n").status == 422
    for changes in ("2 changes", "0 changes"):
        assert upload(ta, ROOM + "import", "table", head + good).status == 303
        assert changes in ta.get(ROOM).text
    assert overrides(grades)["laws"].text == "clear, at last"
    assert overrides(grades, "Ünal 学生 & co")["pieces"].by == "Ada"


def test_feedback_files_are_exported(ta, grades, tmp_path):
    """The desk exports the same zip of feedback files as the command, and says what is missing."""
    worksheet = "Identifier,Full name,ID number\nParticipant 7,Jane,s0\n"
    roster = tmp_path / "worksheet.csv"
    roster.write_text(worksheet, encoding="utf-8")
    with Gradebook(grades) as book:
        done = export_feedback(book, PLATFORMS["moodle"], tmp_path / "out", roster=roster)
    answer = upload(ta, ROOM + "export", "roster", worksheet, lms="moodle", what="feedback")
    assert answer.status == 200
    assert 'filename="feedback-moodle.zip"' in answer.headers["content-disposition"]
    with zipfile.ZipFile(done.files[0]) as archive:
        expected = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(io.BytesIO(answer.body)) as archive:
        found = {name: archive.read(name) for name in archive.namelist()}
    assert found.pop("remarks.txt").decode().splitlines() == [r.text for r in done.remarks]
    assert found == expected
    assert ta.post(ROOM + "export", lms="gradescope", what="feedback").status == 422


@pytest.mark.parametrize("platform", ["canvas", "moodle", "gradescope"])
def test_the_export_equals_that_of_the_command(ta, grades, tmp_path, platform):
    """The desk exports the same bytes as the command; several files come as a zip."""
    with Gradebook(grades) as book:
        done = export(book, PLATFORMS[platform], tmp_path / "out", title="Lab 3")
    answer = ta.post(ROOM + "export", lms=platform, title="Lab 3")
    assert answer.status == 200
    assert "attachment" in answer.headers["content-disposition"]
    expected = {f.relative_to(tmp_path / "out").as_posix(): f.read_bytes() for f in done.files}
    if done.remarks:
        said = "\n".join(remark.text for remark in done.remarks)
        expected["remarks.txt"] = f"{said}\n".encode()
    found = {f"{platform}.csv": answer.body}
    if len(expected) > 1:
        assert f'filename="grades-{platform}.zip"' in answer.headers["content-disposition"]
        with zipfile.ZipFile(io.BytesIO(answer.body)) as archive:
            found = {name: archive.read(name) for name in archive.namelist()}
    assert found == expected


# ------------------------------------------------------------------------------- anonymous


@pytest.mark.parametrize("anonymous", [False, True])
def test_the_form_to_grade_again_knows_what_was_graded(tmp_path, anonymous):
    """It shows paths, rubric and late days of the last grading; hidden names stay hidden."""
    grades = write_class(tmp_path / "g", anonymous=anonymous)
    paths = tuple(str(tmp_path / name) for name in ("team-02", "team-05.zip"))
    save_run(grades, Run(paths=paths, rubric="lab.toml", lateness="late.csv"))
    with at_desk(opened=grades) as who:
        page = who.get(ROOM)
        assert page.value("rubric") == "lab.toml"
        assert page.value("lateness") == "late.csv"
        assert [path in page.text for path in paths] == [not anonymous] * 2
        assert ("last time (2)" in page.text) is anonymous


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("anonymous", [False, True])
def test_a_class_is_graded_again_from_the_desk(tmp_path, anonymous):
    """A late submission is graded into the open class; earlier grades and hidden names stay."""
    team, late, lab = (tmp_path / name for name in ("team-05", "late.csv", "lab.toml"))
    write_team(team, 5)
    late.write_text("submission,days_late\nteam-05,2\n", encoding="utf-8")
    shutil.copy(RUBRICS / "throne-1dof.toml", lab)
    rubric = load_rubric(lab).model_copy(update={"anonymous": anonymous})
    old = make_outcome(make_grade("team-04"), fingerprints=b"")
    grades = tmp_path / "grades"
    grades.mkdir()
    with book_of(grades, old, rubric=rubric) as book:
        book.override("team-04", "pieces", 0.5, why="as told", by="Ada")
    with at_desk(opened=grades) as who:
        sent = {"paths": str(team), "rubric": str(lab), "lateness": str(late)}
        assert who.post(ROOM + "grade", **sent).status == 303
        until(lambda: "data-events" not in who.get(ROOM).text)
        shown = names(who.get(ROOM))
    run = read_run(grades)
    assert run is not None
    assert (run.paths, run.rubric, run.lateness) == ((str(team),), str(lab), str(late))
    with Gradebook(grades) as book:
        entry = {one.submission: one for one in book.entries()}
        assert entry["team-04"].overrides["pieces"].text == "as told"
        assert (entry["team-05"].grade.status, entry["team-05"].grade.days_late) == ("graded", 2)
        assert book.rubric.anonymous == anonymous
    made = sorted(path.name for path in (grades / "feedback").iterdir() if path.is_dir())
    assert made == sorted(shown)
    assert (set(shown) == entry.keys()) is not anonymous


@pytest.mark.slow
@pytest.mark.sample
def test_an_anonymous_class_names_nobody_anywhere(tmp_path):
    """In an anonymous class no page, address or refusal shows a name; exports use pseudonyms."""
    grades = write_class(tmp_path / "g", anonymous=True)
    with Gradebook(grades) as book:
        entries = list(book.entries())
    real = {entry.submission for entry in entries} - {"broken"}
    real |= {author for entry in entries for author in entry.grade.authors if len(author) > 3}
    with at_desk(opened=grades) as who:
        shown = names(who.get(ROOM))
        assert len(shown) == len(entries)
        assert names(who.get(ROOM + "?order=name")) == sorted(shown)
        change(who, shown[0], points="1", why="well")
        tried = ("news?since=0&told=0", "feedback/team-02/feedback.html",
                 "feedback/team-02/grade.json", "anonymous-key.csv")  # fmt: skip
        seen, waiting = set(), [ROOM, at("team-02"), at("nobody"), *(ROOM + one for one in tried)]
        while waiting:
            address = waiting.pop()
            seen.add(address)
            body = who.get(address).text
            for name in real:
                assert name not in unescape(body), (address, name)
            for link in re.findall(r'(?:href|src|action|hx-get)="([^"]+)"', body):
                link = unescape(link).split("#")[0]
                if "feedback/" in link and not link.startswith("/"):
                    link = ROOM + link
                # One team per criterion is enough; going through a list shows the same pages.
                more = link.partition("team?")[2]
                if re.search("(flag|lost|seen)=", more) or (
                    re.search("(criterion|remark)=", more) and shown[1] not in link
                ):
                    continue
                if link.startswith(ROOM) and link not in seen and "?page" not in link:
                    waiting.append(link)
        assert len(seen) > 2 * len(shown)
        head = "submission,criterion,points,why\n"
        for wrong in ("team-02,laws,1,x\n", "team-0,laws,1,x\n"):
            answer = upload(who, ROOM + "import", "table", head + wrong)
            assert answer.status == 422
            assert "team-03" not in answer.text
        table = f"{head}{shown[1]},laws,1,x\n"
        assert upload(who, ROOM + "import", "table", table).status == 303


# ---------------------------------------------------------------------------- older books


# ------------------------------------------------------------- one decision for several teams


def listed(answer: Answer) -> dict[str, list[str]]:
    """Return the rows of the list: points now and after, total now and after."""
    assert answer.status in (200, 409), answer.text
    row = r'(?s)name="team" value="(.*?)".*?((?:<td class="r">.*?</td>\s*){4})'
    rows = re.findall(row, answer.text)
    cells = {unescape(name): re.findall(r'<td class="r">(.*?)</td>', own) for name, own in rows}
    return {name: [re.sub("<.*?>", "", cell) for cell in own] for name, own in cells.items()}


def together(**more: str) -> str:
    """Return the address that lists teams flagged for Hz that lost points for "laws"."""
    about = {"criterion": "laws", "flag": "hz_for_rad_s", "lost": "laws"}
    return f"{ROOM}bulk-change?{urlencode(about | more)}"


def sent(answer: Answer, *teams: str, **fields: str) -> str:
    """Return the form of the list with some teams ticked."""
    seen = {
        f"seen.{name}": unescape(version)
        for name, version in re.findall(r'name="seen\.(.*?)" value="(.*?)"', answer.text)
    }
    ticked = [("team", name) for name in teams]
    return urlencode([*seen.items(), *fields.items(), ("listed", "1"), *ticked])


def apply(who: Visitor, address: str, form: str) -> Answer:
    """Send the form."""
    return who.send(address, form.encode(), kind="application/x-www-form-urlencoded")


def test_one_decision_for_several_teams_is_previewed(ta, grades):
    """One decision for several teams shows points before and after, and changes only ticked teams.

    The decision carries the TA's name and can be undone as a whole. A comment changes no points.
    """
    with Gradebook(grades) as book:
        before = {entry.submission: entry.grade for entry in book.entries()}
    page = ta.get(together(points="0.5"))
    rows = listed(page)
    flagged = {n for n, g in before.items() if any(f.code == "hz_for_rad_s" for f in g.flags)}
    lost = {
        n for n, g in before.items() if any(c.id == "laws" and c.points < 1 for c in g.criteria)
    }
    assert set(rows) == flagged & lost
    left, *ticked = rows
    answer = apply(ta, together(), sent(page, *ticked, do="apply", points="0.5", why="one unit"))
    assert answer.status == 303
    with Gradebook(grades) as book:
        after = {entry.submission: entry for entry in book.entries()}
        for name in ticked:
            given = after[name].overrides["laws"]
            assert (given.points, given.text, given.by) == (0.5, "one unit", "Ada")
            assert rows[name][1:4:2] == ["0.5", f"{after[name].grade.points:g}"]
            assert book.history(name)[1][-1].text == "one unit"
        assert after[left].grade == before[left]
    done = ta.get(answer.headers["location"])
    assert f"{len(ticked)} teams changed" in done.text
    ta.post(answer.headers["location"], do="undo", set=done.value("set"))
    with Gradebook(grades) as book:
        assert {entry.submission: entry.grade for entry in book.entries()} == before
    form = sent(ta.get(together()), *ticked, do="apply", points="same", why="Mind the unit.")
    assert apply(ta, together(), form).status == 303
    with Gradebook(grades) as book:
        for name in ticked:
            entry, said = book.entry(name), criterion(before[name], "laws").message
            assert (entry.overrides, entry.grade.points) == ({}, before[name].points)
            assert criterion(entry.grade, "laws").message == f"{said} Mind the unit."


def test_the_result_is_shown_before_a_decision_also_without_scripts(ta):
    """A form that is sent by "get" has only its fields, not the query of its address."""
    page = ta.get(together(points="0.5"))
    form = page.text.partition('class="bulk-change"')[2].partition("</form>")[0]
    hidden = re.findall(r'<input type="hidden" name="([^"]*)" value="([^"]*)">', form)
    fields = [(unescape(name), unescape(value)) for name, value in hidden]
    fields += [("points", "0.5"), *(("team", name) for name in listed(page))]
    assert listed(ta.get(f"{ROOM}bulk-change?{urlencode(fields)}")) == listed(page)


def test_a_decision_applies_to_all_teams_or_none(ta, grades):
    """If one decision for several teams is not possible for all of them, no team changes."""
    page = ta.get(together())
    names = list(listed(page))
    for fields in ({"points": "0.5", "why": " "}, {"points": "7", "why": "x"},
                   {"other": "many", "points": "same", "why": "x"}):  # fmt: skip
        assert apply(ta, together(), sent(page, *names, do="apply", **fields)).status == 422
    assert apply(ta, together(), sent(page, do="apply", points="1", why="x")).status == 422
    change(ta, names[1], points="0", why="mine")
    answer = apply(ta, together(), sent(page, *names, do="apply", points="0.5", why="one unit"))
    assert answer.status == 409
    assert listed(answer)[names[1]][0] == "0"  # the current version
    given = {name: overrides(grades, name) for name in names}
    assert {name: own["laws"].text for name, own in given.items() if own} == {names[1]: "mine"}
    again = apply(ta, together(), sent(answer, *names, do="apply", points="0.5", why="one unit"))
    assert again.status == 303  # with the versions shown by the refusal


def test_criteria_keep_their_order_during_grading(ta):
    """Criteria keep their order while points are given, so that the next one is never skipped."""

    def titles() -> list[str]:
        found = re.findall(r'<span class="title">(.*?)</span>', ta.get(at("team-05")).text)
        return [unescape(title) for title in found]

    before = titles()
    with_most = before[0]
    criterion = next(c.id for c in two_cart_rubric().criteria if capital(c.title) == with_most)
    for points in ("1", "2"):
        assert change(ta, "team-05", criterion, points=points, why="seen").status == 303
        assert titles() == before


@pytest.mark.slow
@pytest.mark.sample
def test_the_recordings_of_a_team_are_one_click_away(tmp_path):
    """A team's page links to the recordings that were graded, unless a file has changed since."""
    team = a_submission(tmp_path / "lab" / "team-1")
    rubric, out = RUBRICS / "throne-1dof.toml", tmp_path / "grades"
    cartlab_here("grade", tmp_path / "lab", "--rubric", rubric, "--out", out, "--jobs", 1,
                 "--no-figures")  # fmt: skip
    with at_desk(opened=out) as owner:
        page = owner.get(at("team-1"))
        assert 'name="to"' in page.text
        opened = owner.post("/open", folder=page.value("folder"), to=page.value("to"))
        assert opened.headers["location"] == "/student/0/compare"
        owner.post("/student/0/compare")
        until(lambda: "<iframe" in owner.get("/student/0/compare").text)
        assert 'name="to"' in owner.get(at("team-1")).text
        (team / "data" / "new.csv").write_text("t,x1\n0,1\n", encoding="utf-8")
        assert 'name="to"' not in owner.get(at("team-1")).text


def test_one_decision_is_offered_for_the_same_slip(tmp_path):
    """An unstable A is not a reordered A: teams with the same flag may need another decision."""
    slips = {"a": "the order of the states", "b": "", "c": "the order of the states", "d": ""}

    def flag(slip: str) -> Flag:
        evidence = {"parameter": "A(1, 2)", "reported": 1.0, "recomputed": 2.0, "slip": slip}
        return Flag(code="wrong_state_space", parameters=("A",), message="x", evidence=evidence)

    put(
        tmp_path,
        *(make_outcome(make_grade(n, share=0.5, flags=(flag(s),))) for n, s in slips.items()),
    )
    with at_desk(opened=tmp_path) as who:
        for name, same in (("a", ["a", "c"]), ("b", ["b", "d"])):
            page = who.get(at(name, criterion="state-model")).text
            found = re.search(r'href="([^"]*bulk-change[^"]*)"[^>]*>Apply to the 2 teams', page)
            assert found, name
            page = who.get(unescape(found[1]))
            assert sorted(listed(page)) == same


def test_undoing_a_decision_keeps_later_changes(ta, grades):
    """If a decision is undone, teams that were changed after it keep their points and are named."""
    page = ta.get(together())
    names = list(listed(page))
    apply(ta, together(), sent(page, *names, do="apply", points="0.5", why="one unit"))
    change(ta, names[0], points="1", why="right after all")
    ta.post(ROOM + "bulk-change", do="undo", set=ta.get(ROOM).value("set"))
    said = unescape(" ".join(re.findall(r'class="said">(.*?)<', ta.get(ROOM).text)))
    assert (str(len(names) - 1) in said, names[0] in said) == (True, True)
    given = {name: overrides(grades, name) for name in names}
    reasons = {name: own["laws"].text for name, own in given.items() if own}
    assert reasons == {names[0]: "right after all"}


def test_a_grade_is_held_back_and_let_go(ta, grades):
    """The team's page holds a grade back with a reason, and says so; the class can list these."""
    refused = ta.post(at("team-02"), do="hold", why="")
    assert refused.status == 303
    ta.post(at("team-02"), do="hold", why="a case")
    assert 'id="held"' in ta.get(at("team-02")).text
    assert names(ta.get(f"{ROOM}?state=held")) == ["team-02"]
    with Gradebook(grades) as book:
        hold = book.entry("team-02").hold
        assert hold
        assert hold.by == "Ada"
    ta.post(at("team-02"), do="let_go")
    assert names(ta.get(f"{ROOM}?state=held")) == []


def test_publishing_holds_open_cases_back(ta, grades):
    """Teams with shared recordings that nobody reviewed are held back, until somebody decides."""
    ta.post(at("team-03"), do="accept")
    ta.post(f"{ROOM}release", do="release")
    assert names(ta.get(f"{ROOM}?state=held")) == ["team-02"]


def test_one_criterion_is_graded_for_one_team_after_another(ta):
    """With a criterion chosen, each team's page shows it, and saving leads to the next team."""
    walk = {"by": "laws", "order": "name"}
    first, second = names(ta.get(f"{ROOM}?{urlencode(walk)}"))[:2]
    page = ta.get(at(first, **walk))
    assert page.value("criterion") == "laws"
    saved = ta.post(
        at(first, **walk), do="change", criterion="laws", points="0.5", why="half",
        seen=page.value("seen"),
    )  # fmt: skip
    assert saved.status == 303
    after = saved.headers["location"]
    assert f"of={second}" in after
    assert "by=laws" in after
    assert ta.get(after).value("criterion") == "laws"
