"""Submissions are found in folders, in trees of folders, and in downloads of learning platforms."""

import os
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ConfigError, SubmissionError
from pipeline.grading.intake.files import digest, open_submission, packed, unpacked
from pipeline.grading.intake.find import find_hand_ins
from pipeline.grading.intake.lms_names import parse_name
from pipeline.grading.intake.unpack import HAND_IN
from pipeline.submission.load import MAX_DATA_BYTES, NAME, file_problem

TOML = "version = 1\n"


def tree(folder, files):
    """Write text files into a folder."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder


def archive(path, files):
    """Write a zip archive; values are texts or bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as opened:
        for name, content in files.items():
            opened.writestr(name, content)
    return path


def zip_bytes(tmp_path, files):
    return archive(tmp_path / "inner.zip", files).read_bytes()


def hand_ins(tmp_path, *paths):
    return find_hand_ins(paths, scratch=tmp_path / "scratch")


def opened(tmp_path, hand_in):
    """Return the paths of a submission's files, relative to its folder."""
    folder = open_submission(hand_in.sources, tmp_path / "opened" / hand_in.id)
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_a_tree_gives_a_row_for_every_team(tmp_path):
    """Each team of a class gets a row, whether in a section's folder or in a zip file.

    A team whose folder has no submission gets a row too.
    """
    tree(
        tmp_path / "class",
        {
            "section-1/team-01/submission.toml": TOML,
            "section-1/team-02/submission.toml": TOML,
            "section-1/team-03/notes.txt": "we forgot",
            "section-2/team-04/lab/submission.toml": TOML,
            "section-2/team-05/submission.toml": TOML,
            "section-2/team-05/old/submission.toml": TOML,
            ".git/config": "",
        },
    )
    archive(tmp_path / "class" / "section-2" / "team-06.zip", {"submission.toml": TOML})
    found = hand_ins(tmp_path, tmp_path / "class")
    assert [h.id for h in found] == ["lab", "team-01", "team-02", "team-03", "team-05", "team-06"]
    with pytest.raises(SubmissionError, match=r"no submission\.toml in it, only 'notes\.txt'"):
        opened(tmp_path, found[3])
    assert opened(tmp_path, found[5]) == ["submission.toml"]


def test_duplicate_ids_get_the_parent_folders_name(tmp_path):
    """An id is the folder's name; duplicates get the parent folder's name as a prefix."""
    tree(tmp_path, {f"c/{s}/lab/submission.toml": TOML for s in ("ann", "bob")})
    tree(tmp_path, {"c/carl/submission.toml": TOML})
    assert [h.id for h in hand_ins(tmp_path, tmp_path / "c")] == ["ann-lab", "bob-lab", "carl"]


def test_a_canvas_download(tmp_path):
    """In a Canvas download, names, late marks and resubmissions are understood.

    Several loose files of one student make one submission.
    """
    inner = zip_bytes(tmp_path, {"lab3/submission.toml": TOML, "lab3/data/a.csv": "1"})
    download = archive(
        tmp_path / "submissions.zip",
        {
            "doejane_1024_77001_team-07.zip": zip_bytes(
                tmp_path, {"team-07/submission.toml": "old", "team-07/x.csv": "1"}
            ),
            "doejane_1024_77009_team-07-1.zip": zip_bytes(
                tmp_path, {"team-07/submission.toml": TOML}
            ),
            "roeric_LATE_1025_77002_lab3.zip": inner,
            "poeann_1026_77003_lab3.zip": inner,
            "loose_1027_77004_submission.toml": TOML,
            "loose_1027_77005_step.csv": "1,2",
            "empty_1028_text.html": "<p>sorry</p>",
            "LATE_anon_x7Yb2_77006_lab3.zip": inner,  # from an anonymous assignment
        },
    )
    found = {h.id: h for h in hand_ins(tmp_path, download)}
    assert sorted(found) == [
        "anon_x7Yb2-lab3", "empty", "loose", "poeann-lab3", "roeric-lab3", "team-07",
    ]  # fmt: skip
    assert (found["anon_x7Yb2-lab3"].days_late, found["anon_x7Yb2-lab3"].owner) == (
        1.0,
        "anon_x7Yb2",
    )
    assert opened(tmp_path, found["team-07"]) == ["submission.toml"]  # only from the resubmission
    loose = opened(tmp_path, found["loose"])
    assert loose == ["data/step.csv", "step.csv", "submission.toml"]
    assert found["roeric-lab3"].days_late == 1.0
    assert found["poeann-lab3"].days_late == 0.0
    assert found["roeric-lab3"].owner == "roeric (canvas 1025)"
    with pytest.raises(SubmissionError, match="no submission"):
        opened(tmp_path, found["empty"])


def test_a_moodle_download(tmp_path):
    """A Moodle download has one folder for each student, which holds a zip file or the files."""
    inner = zip_bytes(tmp_path, {"submission.toml": TOML})
    download = archive(
        tmp_path / "Lab 3.zip",
        {
            "Jane Doe_1024_assignsubmission_file_/work.zip": inner,
            "Zoë Ünal_1025_assignsubmission_file_/submission.toml": TOML,
            "Ann Poe_1026_assignsubmission_file_submission.toml": TOML,
            "Default group_assignsubmission_file_/submission.toml": TOML,
            "Jane Doe_1024_assignsubmission_onlinetext_/onlinetext.html": "<p>see the file</p>",
        },
    )
    found = {h.id: h for h in hand_ins(tmp_path, download)}
    assert sorted(found) == ["Ann Poe", "Default group", "Jane Doe", "Zoë Ünal"]
    assert found["Jane Doe"].owner == "Jane Doe (moodle 1024)"
    assert found["Default group"].owner == "Default group"
    assert all(opened(tmp_path, h) for h in found.values())


def test_a_gradescope_download(tmp_path):
    """In a Gradescope download, names come from the metadata.

    A folder that the metadata do not list keeps its own name.
    """
    metadata = (
        "submission_77:\n  :submitters:\n  - :name: Jane Doe\n    :sid: A1\n"
        "  - :name: Ric Roe\n  :created_at: 2026-11-20 10:00:00.123456000 -08:00\n"
        "  :history:\n  - :created_at: 2026-11-19 10:00:00.5 Z\n"
    )
    download = archive(
        tmp_path / "export.zip",
        {
            "assignment_9_export/submission_metadata.yml": metadata,
            "assignment_9_export/submission_77/submission.toml": TOML,
            "assignment_9_export/submission_78/submission.toml": TOML,
        },
    )
    known, unknown = hand_ins(tmp_path, download)
    assert (known.id, unknown.id) == ("Jane Doe, Ric Roe", "submission_78")
    assert known.owner == "Jane Doe, Ric Roe (gradescope 77)"
    assert (known.handed_in, unknown.handed_in) == ("2026-11-20T10:00:00-08:00", "")


def test_yaml_aliases_in_metadata_are_not_expanded(tmp_path):
    """Metadata with nested YAML aliases are not expanded, so they cannot fill the memory."""
    laughs = "".join(f"  - &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]\n" for i in range(1, 30))
    metadata = f"x:\n  - &l0 [ha]\n{laughs}submission_77:\n  :submitters:\n  - :name: *l29\n"
    tree(tmp_path / "c", {"submission_metadata.yml": metadata + "  :created_at: *l29\n",
                          "submission_77/submission.toml": TOML})  # fmt: skip
    (found,) = hand_ins(tmp_path, tmp_path / "c")
    assert (found.id, found.handed_in) == ("submission_77", "")


def test_a_folder_keeps_its_name_whatever_platform_it_looks_like(tmp_path):
    """A team's folder keeps its name, even if it looks like the name of a file from Canvas."""
    names = ("throne_2026_03_alpha", "throne_2026_03_beta", "sec_01_02_x", "ME405_03_07_team")
    tree(tmp_path / "c", {f"{name}/submission.toml": TOML for name in names})
    found = hand_ins(tmp_path, tmp_path / "c")
    assert [hand_in.id for hand_in in found] == sorted(names)


@pytest.mark.parametrize("wrapped", ["", "class/", "term/class/"])
def test_a_refused_file_affects_only_its_own_submission(tmp_path, wrapped):
    """If a file in a class archive is refused, only the submission that contains it fails.

    The file gets no row of its own, unless its submission has no other files.
    """
    members = {f"{wrapped}team-{n}/submission.toml": TOML for n in range(3)}
    class_ = archive(tmp_path / "all.zip", members)
    with zipfile.ZipFile(class_, "a") as opened_:
        for name in ("team-1/data/link.csv", "team-7/submission.toml"):
            info = zipfile.ZipInfo(wrapped + name)
            info.create_system, info.external_attr = 3, 0o120777 << 16
            opened_.writestr(info, "/etc/passwd")
    found = {hand_in.id: hand_in.problem for hand_in in hand_ins(tmp_path, class_)}
    assert list(found) == ["team-0", "team-1", "team-2", "team-7"]
    assert [bool(why) for why in found.values()] == [False, True, False, True]
    assert all(why.endswith("is a link") for why in found.values() if why)


def test_metadata_written_by_a_student_are_not_read(tmp_path):
    """Metadata are read only at the top of a download, where students cannot write."""
    own = "submission_1:\n  :submitters:\n  - :name: Nobody\n"
    tree(tmp_path / "c", {"a/submission_1/submission.toml": TOML,
                          "a/submission_metadata.yml": own,
                          "b/submission.toml": TOML})  # fmt: skip
    assert [hand_in.owner for hand_in in hand_ins(tmp_path, tmp_path / "c")] == [
        "", "submission_1 (gradescope 1)",
    ]  # fmt: skip


def test_a_zip_of_two_submissions_keeps_its_own_name(tmp_path):
    """A zip file with two submissions is listed under its own name, since its team is unknown."""
    twice = {f"{team}/submission.toml": TOML for team in ("team-01", "team-02")}
    (tmp_path / "class").mkdir()
    archive(tmp_path / "class" / "two.zip", twice)
    archive(tmp_path / "class" / "one.zip", {"team-01/submission.toml": TOML})
    one, two = hand_ins(tmp_path, tmp_path / "class")
    assert (one.id, two.id) == ("team-01", "two")
    with pytest.raises(SubmissionError, match="which one should be graded"):
        opened(tmp_path, two)


def test_one_students_zip_is_one_submission(tmp_path):
    """A student's zip file is one submission, and a broken zip file gets a row."""
    good = archive(tmp_path / "team-07.zip", {"submission.toml": TOML})
    bad = tmp_path / "team-08.zip"
    bad.write_bytes(b"PK\x03\x04 no more")
    first, second = hand_ins(tmp_path, good, bad)
    assert (first.id, second.id) == ("team-07", "team-08")
    with pytest.raises(SubmissionError, match=r"'team-08\.zip': not a complete zip archive: send"):
        opened(tmp_path, second)
    bad.write_bytes(b"")  # an upload that was interrupted
    with pytest.raises(SubmissionError, match=r"'team-08\.zip': is empty"):
        opened(tmp_path, *hand_ins(tmp_path, bad))


@pytest.mark.parametrize("packed", [False, True])
def test_an_incomplete_class_archive_is_refused(tmp_path, packed):
    """If a class archive is incomplete, nobody is graded.

    A single incomplete submission still gets a row.
    """
    teams = {f"team-{n}": {"submission.toml": TOML, "data/a.csv": "1,2\n" * 99} for n in range(4)}
    files = {f"{team}/{name}": text for team, own in teams.items() for name, text in own.items()}
    if packed:
        files = {f"{team}.zip": zip_bytes(tmp_path, own) for team, own in teams.items()}
    download = archive(tmp_path / "class.zip", files)
    whole = download.read_bytes()
    single = archive(tmp_path / "team-9.zip", {"submission.toml": TOML})
    single.write_bytes(single.read_bytes()[:-30])
    download.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ConfigError, match=r"'class\.zip': not a complete zip archive"):
        hand_ins(tmp_path, single, download)
    (found,) = hand_ins(tmp_path, single)
    assert found.id == "team-9"


@pytest.mark.parametrize("how", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_class_archive_cut_in_its_first_submission_is_refused(tmp_path, how):
    """If a class archive ends within its first submission, it is refused.

    It is not taken for a single student's submission.
    """
    own = zip_bytes(tmp_path, {"submission.toml": TOML, "data/a.csv": "1,2\n" * 99})
    download = tmp_path / "class.zip"
    with zipfile.ZipFile(download, "w", how) as packing:
        packing.writestr("team-0.zip", own)
        packing.writestr("team-1.zip", own)
    download.write_bytes(download.read_bytes()[:200])
    with pytest.raises(ConfigError, match=r"'class\.zip': not a complete zip archive"):
        hand_ins(tmp_path, download)


def test_a_zip_with_a_deleted_member_is_accepted(tmp_path):
    """A zip file from which a member was deleted is still accepted.

    Its table of contents is valid, although the deleted member's bytes are still in the file.
    """
    taken = archive(tmp_path / "team-1.zip", {"draft.txt": "x", "submission.toml": TOML})
    with zipfile.ZipFile(taken, "a") as opened_again:
        del opened_again.filelist[0]
        opened_again.comment = b"tidied"  # makes zipfile write the table of contents again
    (found,) = hand_ins(tmp_path, taken)
    assert opened(tmp_path, found) == ["submission.toml"]


def test_a_hostile_submission_in_a_download_fails_alone(tmp_path):
    """A hostile submission in a class download fails alone; all others are graded.

    The faults are paths that leave the folder, very deep folders, a password and broken bytes.
    """
    download = archive(
        tmp_path / "class.zip",
        {
            **{f"team-{n}/submission.toml": TOML for n in range(3)},
            "../up/x": "",
            "evil-1/../../x": "",
            "evil-2/" + "a/" * 1_500 + "x": "",
            "evil-3/locked.csv": "1",
            "evil-4/submission.toml": "0" * 500,
        },
    )
    raw = bytearray(download.read_bytes())
    for signature, name_at, flags_at in ((b"PK\x03\x04", 30, 6), (b"PK\x01\x02", 46, 8)):
        at = raw.find(b"evil-3/", raw.find(signature)) if signature == b"PK\x03\x04" else 0
        at = at or raw.find(b"evil-3/", raw.find(b"PK\x01\x02"))
        raw[at - name_at + flags_at] |= 1  # marks the member as encrypted
    raw[raw.find(b"0" * 500) + 7] ^= 1  # makes the checksum wrong
    download.write_bytes(raw)
    found = {h.id: h.problem for h in hand_ins(tmp_path, download)}
    assert {name: why for name, why in found.items() if not why} == {
        f"team-{n}": "" for n in range(3)
    }
    assert {name: why.rpartition(" ")[2] for name, why in found.items() if why} == {
        "up": "archive", "evil-1": "archive", "evil-2": "deep", "evil-3": "password",
        "evil-4": "'evil-4/submission.toml')",
    }  # fmt: skip


def test_a_hidden_folder_counts_only_with_a_submission(tmp_path):
    """A hidden folder counts only if it holds a submission; `.git` is ignored."""
    tree(
        tmp_path / "c",
        {name + "/submission.toml": TOML for name in ("...", ".lab", "~$x", "a")}
        | {".git/config": "", "__MACOSX/submission.toml": TOML},
    )
    assert [h.id for h in hand_ins(tmp_path, tmp_path / "c")] == ["_", "a", "lab", "~$x"]


def test_folders_of_results_are_not_graded(tmp_path):
    """Folders with earlier results are not graded as submissions, and a message names them.

    A team's folder may still be called `results`, for example.
    """
    made = ("class.html", "feedback/.made.json", "feedback/a/feedback.html", "gradescope/a/x")
    tree(tmp_path / "c", dict.fromkeys(("a/submission.toml", *made), TOML))
    tree(tmp_path / "c" / "grades", dict.fromkeys(made, ""))
    told = []
    found = find_hand_ins([tmp_path / "c"], scratch=tmp_path / "scratch", say=told.append)
    assert [h.id for h in found] == ["a"]
    assert [text.split("'")[1] for text in told] == ["c/feedback", "c/grades", "c/gradescope"]
    tree(tmp_path / "d", dict.fromkeys(("a/submission.toml", "feedback/submission.toml"), TOML))
    assert [h.id for h in hand_ins(tmp_path, tmp_path / "d")] == ["a", "feedback"]


@pytest.mark.parametrize("name", ["t.tar.gz", "t.tgz", "t.7z", "t.rar", "t.tar"])
def test_an_archive_of_another_format_gets_a_row(tmp_path, name):
    """An archive in a format other than zip gets a row that says so.

    Inside a team's folder, the archive is taken for a backup and ignored.
    """
    tree(tmp_path / "c", {"a/submission.toml": TOML, "b/lab/submission.toml": TOML, name: "packed"})
    tree(tmp_path / "c" / "b", {name: "packed"})
    found = {h.id: h for h in hand_ins(tmp_path, tmp_path / "c")}
    assert sorted(found) == ["a", "lab", "t"]
    with pytest.raises(SubmissionError, match=f"{name}' cannot be opened; submit a zip file"):
        opened(tmp_path, found["t"])


@pytest.mark.parametrize("beside", [(), ("figures/bode.png",), ("notes.md",)])
def test_a_team_without_its_file_keeps_its_name(tmp_path, beside):
    """A team without `submission.toml` gets a row with the team's name, not its data folder's."""
    for where in ("c/team-7", "alone", "section/only/team-7"):
        tree(tmp_path / where, dict.fromkeys(("data/step.csv", *beside), "1,2"))
    tree(tmp_path / "c", {"a/submission.toml": TOML})
    ids = {where: [h.id for h in hand_ins(tmp_path, tmp_path / where)]
           for where in ("c", "alone", "section")}  # fmt: skip
    assert ids == {"c": ["a", "team-7"], "alone": ["alone"], "section": ["team-7"]}


def test_a_name_of_many_numbers_is_read_at_once():
    """Names of a million characters with many numbers are parsed without delay."""
    for part in ("_1", "_LATE_1", "_assignsubmission_", "anon_", "-1.a"):
        parse_name(part * (1_000_000 // len(part)) + "\n")


def test_archives_in_archives_are_opened_to_a_limited_depth(tmp_path):
    """A zip file inside a zip file is opened, but not one that is ten levels deep."""
    content = zip_bytes(tmp_path, {"submission.toml": TOML})
    nested = zip_bytes(tmp_path, {"inner.zip": content})
    (found,) = hand_ins(tmp_path, archive(tmp_path / "a.zip", {"b.zip": nested}))
    assert opened(tmp_path, found) == ["submission.toml"]
    for _ in range(9):
        content = zip_bytes(tmp_path, {"inner.zip": content})
    (found,) = hand_ins(tmp_path, archive(tmp_path / "deep.zip", {"x.zip": content}))
    with pytest.raises(SubmissionError, match="no submission"):
        opened(tmp_path, found)


@pytest.fixture
def few(monkeypatch):
    """Allow twenty files in a submission instead of two thousand."""
    monkeypatch.setattr("pipeline.grading.intake.files.HAND_IN", replace(HAND_IN, members=20))


@pytest.mark.usefixtures("few")
def test_many_nested_archives_share_one_limit(tmp_path):
    """The limit on the number of files applies to all archives of a submission together."""
    part = zip_bytes(tmp_path, {str(i): "" for i in range(4)})
    whole = archive(tmp_path / "a.zip", {f"{i}.zip": part for i in range(10)})
    with pytest.raises(SubmissionError, match="files"):
        open_submission([whole], tmp_path / "opened")


def test_two_submissions_at_one_depth_are_refused(tmp_path):
    """If a folder has two submissions at the same depth, it is refused.

    A submission at a higher level is graded.
    """
    files = {"a/submission.toml": TOML, "b/submission.toml": TOML}
    folder = tree(tmp_path / "t", files)
    with pytest.raises(SubmissionError, match=r"which one.*'a/submission\.toml' and 'b/"):
        open_submission([folder], tmp_path / "opened")
    tree(folder, {"submission.toml": TOML})
    assert open_submission([folder], tmp_path / "again") == tmp_path / "again"


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes need rights on Windows")
def test_links_and_pipes_are_not_followed(tmp_path):
    """Links and pipes in a submission are not read; a linked folder in a class gets a row."""
    secret = tree(tmp_path / "ours", {"secret.csv": "secret"})
    folder = tree(tmp_path / "c/team/", {"submission.toml": TOML})
    (folder / "data").symlink_to(secret)
    (folder / "link.csv").symlink_to(secret / "secret.csv")
    os.mkfifo(folder / "pipe.csv")
    (tmp_path / "c" / "elsewhere").symlink_to(secret)
    linked, team = hand_ins(tmp_path, tmp_path / "c")
    assert "is a link" in linked.problem
    assert opened(tmp_path, team) == ["submission.toml"]
    assert len(digest(team.sources)) == 64


def test_a_recording_that_is_too_large_is_refused_and_not_missed(tmp_path):
    """If a recording is too large, the reason says so; it does not say that the file is missing."""
    team = tree(tmp_path / "team-01", {"submission.toml": TOML, "data/long.csv": ""})
    os.truncate(team / "data" / "long.csv", MAX_DATA_BYTES + 1)
    folder = open_submission([team], tmp_path / "opened")
    assert "100,000,001 bytes, the limit is 100,000,000" in str(
        file_problem(folder, "data/long.csv")
    )


@pytest.mark.usefixtures("few")
def test_too_many_files_are_refused_with_one_reason(tmp_path):
    """A submission with too many files is refused with the same reason on every machine."""
    team = tree(tmp_path / "team", {NAME: TOML, **{f"junk/{i}": "" for i in range(20)}})
    (tmp_path / "there").mkdir()
    unpacked(packed([team]), tmp_path / "there")
    for folder in (team, tmp_path / "there"):
        with pytest.raises(SubmissionError, match=r"more than 20 files; submit submission.toml"):
            open_submission([folder], tmp_path / f"open-{folder.name}", digest=digest([team]))
    (team / "junk" / "7").unlink()
    assert open_submission([team], tmp_path / "again").joinpath(NAME).is_file()


def test_a_submission_is_unchanged_on_another_machine(tmp_path):
    """A submission sent to another machine has the same files and the same hash there."""
    folder = tree(tmp_path / "t", {"submission.toml": TOML, "data/ü.csv": "1", ".DS_Store": "x"})
    unpacked(packed([folder]), tmp_path / "there")
    assert digest([tmp_path / "there"]) == digest([folder])
    before = digest([folder])
    tree(folder, {"data/ü.csv": "2"})
    assert digest([folder]) != before


def test_an_empty_or_missing_folder_is_an_error(tmp_path):
    """An empty or missing folder is an error."""
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="nothing to grade"):
        hand_ins(tmp_path, tmp_path / "empty")
    with pytest.raises(ConfigError, match="no such"):
        hand_ins(tmp_path, tmp_path / "absent")


@given(st.lists(st.text(min_size=1, max_size=30), min_size=1, max_size=6))
def test_any_name_gives_a_valid_id(tmp_path_factory, names):
    """For any name, the id is unique, printable, not too long, and stays inside its folder."""
    from pipeline.grading.intake.find import HandIn, _with_ids

    found = [HandIn(id=name, parent="p") for name in names]
    ids = [hand_in.id for hand_in in _with_ids(found)]
    assert len({i.casefold() for i in ids}) == len(names)
    for i in ids:
        assert i.isprintable()
        assert len(i) <= 110
        assert Path("feedback", i).parent == Path("feedback")


@given(st.text(max_size=60))
def test_any_name_can_be_read(name):
    """Any name can be parsed as a learning platform's file name without an error."""
    found = parse_name(name)
    assert found is None or found.owner
