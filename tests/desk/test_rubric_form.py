"""Without scripts, the rubric's pages list, edit and preview rubrics."""

import json
import re
import shutil
from collections.abc import Iterator
from html import unescape
from pathlib import Path
from urllib.parse import urlencode

import pytest

from pipeline.desk.instructor.rubric_list import own_rubrics
from pipeline.desk.users import User
from pipeline.grading.rubric import source_of
from pipeline.grading.rubric_file import load_rubric
from pipeline.resources import EXAMPLES, RUBRICS
from tests.helpers.desks import Answer, Visitor, at_desk, wrongs
from tests.helpers.grades import write_class_of_two
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("all_work_here")
ONE_CART = (RUBRICS / "throne-1dof.toml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def visitor() -> Iterator[Visitor]:
    """Return a visitor at a desk."""
    with at_desk() as visitor:
        yield visitor


@pytest.fixture
def lab(tmp_path) -> Path:
    """Write an instructor's rubric."""
    path = tmp_path / "lab.toml"
    path.write_text(ONE_CART, encoding="utf-8")
    return path


def editor(visitor: Visitor, path: Path) -> Answer:
    """Return the page of the rubric."""
    page = visitor.get(f"/rubric/?{urlencode({'file': path})}")
    assert page.status == 200, page.text
    return page


def sent(page: Answer, path: Path, **changed: str) -> dict[str, str]:
    """Return the fields of a page's form after some of them were changed."""
    shown = unescape(page.value("shown"))
    typed = re.search(r'<textarea name="text"[^>]*>\n?(.*?)</textarea>', page.text, re.DOTALL)
    assert typed
    fields = {"file": str(path), "seen": page.value("seen"), "shown": shown}
    fields["text"] = unescape(typed[1])
    return fields | json.loads(shown) | changed


# --------------------------------------------------------------------------- the file


def test_a_rubric_is_saved_only_when_valid(visitor, tmp_path):
    """A rubric is saved only if it is valid; otherwise the mistake is shown at its line.

    A new rubric starts from a shipped one.
    """
    path = tmp_path / "rubric.toml"
    page = visitor.get(f"/rubric/?{urlencode({'file': path, 'start': 'throne-2dof'})}")
    text = (RUBRICS / "throne-2dof.toml").read_text(encoding="utf-8")
    assert unescape(page.text).count(text.strip()) == 1
    line = next(i for i, one in enumerate(text.split("\n"), 1) if one.startswith("title"))
    spoilt = text.replace("title", "titel", 1)
    answer = visitor.post("/rubric/save", file=str(path), text=spoilt, seen=page.value("seen"))
    assert answer.status == 422
    assert f'<li value="{line}" class="bad" id="line-{line}"><code>titel' in answer.text
    assert f'class="result">Line {line}: titel:' in answer.text
    assert f'href="#line-{line}"' in answer.text
    assert not path.exists()
    crlf = text.replace("\n", "\r\n")  # as browsers send it
    saved = visitor.post("/rubric/save", file=str(path), text=crlf, seen=page.value("seen"))
    assert saved.status == 303
    assert path.read_text(encoding="utf-8").rstrip() == text.rstrip()
    assert load_rubric(path) == load_rubric(Path("throne-2dof"))


def test_a_rubric_changed_meanwhile_is_not_overwritten(visitor, lab):
    """If a rubric was changed on disk meanwhile, both versions are shown and nothing is written."""
    seen = editor(visitor, lab).value("seen")
    lab.write_text(f"# by another\n{ONE_CART}", encoding="utf-8")
    mine = f"# mine\n{ONE_CART}"
    answer = visitor.post("/rubric/save", file=str(lab), text=mine, seen=seen)
    assert answer.status == 409
    assert "# by another" in answer.text
    assert "# mine" in answer.text
    assert lab.read_text(encoding="utf-8").startswith("# by another")


def test_a_new_rubric_does_not_replace_another_one(visitor, lab):
    """A new rubric that is saved as an existing file comes back, with a message at its name."""
    before = lab.read_text(encoding="utf-8")
    for action in ("save", "check"):
        text = f"# mine\n{ONE_CART}"
        new = visitor.post(f"/rubric/{action}", file=str(lab), text=text, seen="new")
        assert (new.status, new.wrong_fields) == (409, {"file"})
        assert (new.value("file"), new.value("seen")) == (str(lab), "new")
        assert "# mine" in new.text
        assert lab.read_text(encoding="utf-8") == before


@pytest.mark.slow
@pytest.mark.sample
def test_a_rubric_is_found_in_a_folder_of_any_name(visitor, tmp_path):
    """A rubric is found even if its folder's name has characters that are special in addresses.

    A bad file name is refused at its field, and what was typed comes back.
    """
    folder = tmp_path / "R+D & co #2 100%"
    folder.mkdir()
    path = folder / "rubric.toml"
    saved = visitor.post("/rubric/save", file=str(path), text=ONE_CART, seen="new")
    assert visitor.get(saved.headers["location"]).value("file") == str(path)
    for file in ("", "rubric.txt", "/nowhere/at/all/rubric.toml", "a\x00.toml", "~nosuch/r.toml",
                 "a" * 300 + ".toml"):  # fmt: skip
        for action in ("save", "check", "preview"):
            text = f"# mine\n{ONE_CART}"
            answer = visitor.post(f"/rubric/{action}", file=file, text=text, seen="new")
            assert (answer.status, answer.wrong_fields) == (422, {"file"})
            assert "# mine" in answer.text
            assert answer.value("file") == file


def test_every_shipped_rubric_is_one_click_away(visitor, lab, tmp_path, monkeypatch):
    """The page lists all shipped rubrics and those in the folder, each one click away.

    A new rubric gets a name that is not in use.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rubric.toml").write_text(ONE_CART.replace("points", "pionts"), encoding="utf-8")
    (tmp_path / "other.toml").write_text("a = 1\n", encoding="utf-8")
    page = unescape(visitor.get("/rubric/").text)
    for path in RUBRICS.glob("*.toml"):
        assert f'href="/rubric/?start={path.stem}"' in page
    assert "lab.toml" in page
    assert "other.toml" not in page
    begun = visitor.get("/rubric/?start=throne-3dof")
    assert begun.value("file") == str(tmp_path / "rubric-2.toml")
    assert begun.value("seen") == "new"


def test_a_workshop_shows_only_its_own_files(tmp_path):
    """An instructor sees the rubrics in the workshop, but none outside, even through a link."""
    shop = tmp_path / "shop"
    for path in (shop / "deep" / "a.toml", shop / ".hidden" / "b.toml", tmp_path / "c.toml"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(ONE_CART, encoding="utf-8")
    (shop / "d.toml").symlink_to(tmp_path / "c.toml")
    user = User(name="Ada", role="instructor", workshop=shop.resolve())
    assert [one.name for one in own_rubrics(user)] == ["deep/a.toml"]


# --------------------------------------------------------------------------- the form


def test_the_form_and_the_text_may_both_be_changed(visitor, lab):
    """If both the form and the text are changed, the number is inserted into the typed text."""
    page = editor(visitor, lab)
    text = ONE_CART.replace("points are rounded to multiples of it", "quarters")
    assert text != ONE_CART
    fields = sent(page, lab, **{"criteria.pieces.points": "1,5", "text": text})
    assert visitor.post("/rubric/save", **fields).status == 303
    written = lab.read_text(encoding="utf-8")
    assert written == text.replace("points = 1\n", "points = 1.5\n", 1)


def test_a_wrong_number_is_shown_at_its_field_and_line(visitor, lab):
    """A wrong number is reported at its field and at its line of the text; nothing is saved.

    The typed text stays on the page.
    """
    page = editor(visitor, lab)
    answer = visitor.post("/rubric/save", **sent(page, lab, **{"criteria.pieces.points": "1.1"}))
    line = ONE_CART.split("\n").index("points = 1") + 1
    assert answer.status == 422
    assert f'class="result">Line {line}: ' in answer.text
    assert f"see line {line}" in wrongs(answer.text)
    late = visitor.post("/rubric/save", **sent(page, lab, **{"late.percent_per_day": "150"}))
    assert (late.status, late.wrong_fields) == (422, {"late-percent_per_day"})
    assert re.search(r'name="criteria.pieces.points"[^>]*value="1.1"[^>]*aria-invalid', answer.text)
    none = visitor.post("/rubric/save", **sent(page, lab, step="half"))
    assert any("'half'" in wrong for wrong in wrongs(none.text))
    assert lab.read_text(encoding="utf-8") == ONE_CART


def test_a_number_survives_a_mistake_in_the_text(visitor, lab):
    """While the text is wrong, a number changed in the form waits and is inserted later."""
    page = editor(visitor, lab)
    wrong = ONE_CART.replace("version = 1", "version = one")
    fields = sent(page, lab, **{"late.percent_per_day": "50", "text": wrong})
    answer = visitor.post("/rubric/check", **fields)
    again = sent(answer, lab, **{"late.percent_per_day": answer.value("late.percent_per_day")})
    assert visitor.post("/rubric/save", **(again | {"text": ONE_CART})).status == 303
    assert load_rubric(lab).late.percent_per_day == 50


@pytest.mark.parametrize("shown", ["", "no JSON", "[]", '{"criteria.none.points": "1"}', "7"])
def test_an_unknown_field_changes_nothing(visitor, lab, shown):
    """If a form has a field that its page never showed, nothing changes and no error occurs."""
    seen = editor(visitor, lab).value("seen")
    fields = {"file": str(lab), "text": ONE_CART, "seen": seen, "shown": shown}
    answer = visitor.post("/rubric/check", **fields, **{"criteria.none.points": "2"})
    assert answer.status == 200
    assert not any("itself failed" in wrong for wrong in wrongs(answer.text))


# ------------------------------------------------------------------------ the preview


def test_a_preview_shows_each_team_before_anything_is_written(tmp_path, lab):
    """The preview shows each team's change, the largest first, before anything is written.

    If a change needs the recordings, the preview guesses no points. Then the rubric is saved and
    applied.
    """
    write_class_of_two(tmp_path / "graded")
    with at_desk(opened=tmp_path / "graded") as visitor:
        page = editor(visitor, lab)
        text = ONE_CART.replace("at_least = 8", "at_least = 9")
        shown = visitor.post("/rubric/preview", **sent(page, lab, text=text), **{"class": "0"})
        assert "<li><code>required</code></li>" in shown.text
        assert '<th scope="row">' not in shown.text
        fields = sent(page, lab, **{"late.percent_per_day": "50", "criteria.data.points": "2"})
        shown = visitor.post("/rubric/preview", **fields, **{"class": "0"})
        assert shown.status == 200, shown.text
        rows = re.findall(r'<tr>\s*<th scope="row">.*?</tr>', shown.text, re.DOTALL)
        assert ["team-2" in rows[0], "team-1" in rows[1]] == [True, True]
        assert "late: −" in rows[0]
        assert re.search("20 → 21", rows[1])
        assert lab.read_text(encoding="utf-8") == ONE_CART
        drawn = re.search(r'src="(/rubric/preview.svg[^"]*)"', shown.text)
        assert drawn
        assert visitor.get(unescape(drawn[1])).body.startswith(b"<svg")
        kept = {name: unescape(shown.value(name)) for name in ("file", "seen")}
        typed = re.search(r"<textarea[^>]*>\n?(.*?)</textarea>", shown.text, re.DOTALL)
        assert typed
        saved = visitor.post("/rubric/save", **kept, text=unescape(typed[1]))
        assert load_rubric(lab).late.percent_per_day == 50
        assert 'action="/grades/0/grade"' in visitor.get(saved.headers["location"]).text


@pytest.mark.slow
@pytest.mark.sample
def test_a_rubric_is_tried_on_simulated_students(visitor, lab, tmp_path):
    """The typed rubric grades students with the recordings of a folder; nothing is saved."""
    shutil.copytree(EXAMPLES / "one-cart", tmp_path / "reference")
    page = editor(visitor, lab)
    fields = sent(page, lab, **{"criteria.data.points": "2"})
    refused = visitor.post("/rubric/simulated", **fields, reference=str(tmp_path))
    assert refused.status == 422
    assert 'id="reference-wrong"' in refused.text
    started = visitor.post("/rubric/simulated", **fields, reference=str(tmp_path / "reference"))
    address = started.headers["location"]
    until(lambda: 'http-equiv="refresh"' not in visitor.get(address).text)
    shown = visitor.get(address)
    assert 'data-state="done"' in shown.text
    assert re.search(r"20 honest students +21", shown.text)
    assert lab.read_text(encoding="utf-8") == ONE_CART
    assert visitor.get("/rubric/simulated?file=none.toml").status == 404


def test_a_preview_of_an_anonymous_class_shows_no_name(tmp_path, lab):
    """The preview of an anonymous class shows no name, and its order reveals none."""
    write_class_of_two(tmp_path / "graded", anonymous=True)
    with at_desk(opened=tmp_path / "graded") as visitor:
        fields = sent(editor(visitor, lab), lab, **{"criteria.data.points": "2"})
        shown = visitor.post("/rubric/preview", **fields, **{"class": "0"}).text
    assert "anon-" in shown
    assert "team-1" not in shown


def test_a_preview_needs_an_open_class_and_a_valid_rubric(visitor, lab):
    """A preview of a class that is not open is refused; a wrong rubric leads back to the editor."""
    page = editor(visitor, lab)
    for number in ("", "0", "-1", "²", "9" * 30):
        assert visitor.post("/rubric/preview", **sent(page, lab), **{"class": number}).status == 404
    spoilt = sent(page, lab, text="version = 2\n")
    assert visitor.post("/rubric/preview", **spoilt, **{"class": "0"}).status == 422
    for query in ("", "before=1", "before=1.2&after=1.2.3", "before=1.x&after=1.2"):
        assert visitor.get(f"/rubric/preview.svg?{query}").status == 404


def test_the_form_chooses_what_judges_a_criterion(visitor, lab):
    """A choice of the form becomes the key `from` of its criterion; others stay as they are."""
    page = editor(visitor, lab)
    fields = sent(page, lab, **{"criteria.state-model.from": "own"})
    assert visitor.post("/rubric/save", **fields).status == 303
    sources = {one.id: source_of(one) for one in load_rubric(lab).criteria}
    assert (sources["state-model"], sources["prefilter"]) == ("own", "either")
    assert lab.read_text("utf-8").count("from = ") == 1
    assert json.loads(unescape(editor(visitor, lab).value("shown")))["criteria.state-model.from"]
