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
from pipeline.grading.intake.unpack import HAND_IN
from pipeline.grading.platforms import parse_name
from pipeline.submission.load import MAX_DATA_BYTES, NAME, file_problem

TOML = "version = 1\n"
FILES = {"submission.toml": TOML, "data/a.csv": "1,2\n" * 99}


def tree(folder, files):
    """Write text files into a folder; without texts, each holds a submission's first line."""
    for name in files:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(files[name] if isinstance(files, dict) else TOML, encoding="utf-8")
    return folder


def archive(path, files, how=zipfile.ZIP_STORED):
    """Write a zip archive; values are texts or bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", how) as opened:
        for name in files:
            opened.writestr(name, files[name] if isinstance(files, dict) else TOML)
    return path


def zip_bytes(tmp_path, files):
    return archive(tmp_path / "inner.zip", files).read_bytes()


def hand_ins(tmp_path, *paths):
    return find_hand_ins(paths, scratch=tmp_path / "scratch")


def opened(tmp_path, hand_in):
    """Return the paths of a submission's files, relative to its folder."""
    folder = open_submission(hand_in.sources, tmp_path / "opened" / hand_in.id)
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def why_not(tmp_path, hand_in) -> str:
    """Return why a submission cannot be opened."""
    with pytest.raises(SubmissionError) as error:
        opened(tmp_path, hand_in)
    return str(error.value)


# ------------------------------------------------------------------------ folders and names


TREES = {  # paths of submissions, and of other files; the ids that are found
    "sections": (
        ("1/team-01", "1/team-02", "2/team-04/lab", "2/team-05", "2/team-05/old"),
        ("1/team-03/notes.txt", ".git/config"),
        ["lab", "team-01", "team-02", "team-03", "team-05"],
    ),
    "the folder above is added to equal names": (
        ("ann/lab", "bob/lab", "carl"), (), ["ann-lab", "bob-lab", "carl"],
    ),
    "folders with names like files of Canvas": (
        ("throne_2026_03_alpha", "sec_01_02_x", "ME405_03_07_team"), (),
        ["ME405_03_07_team", "sec_01_02_x", "throne_2026_03_alpha"],
    ),
    "hidden folders count only with a submission": (
        ("...", ".lab", "~$x", "a", "__MACOSX"), (".git/config",), ["_", "a", "lab", "~$x"],
    ),
    "a team may be called like results": (("a", "feedback"), (), ["a", "feedback"]),
}  # fmt: skip


@pytest.mark.parametrize("case", TREES)
def test_a_tree_gives_a_row_for_every_team(tmp_path, case):
    """Each team gets a row under the name of its folder, also if its folder has no submission."""
    teams, others, ids = TREES[case]
    tree(tmp_path / "c", [f"{team}/{NAME}" for team in teams] + list(others))
    assert [h.id for h in hand_ins(tmp_path, tmp_path / "c")] == ids


def test_a_class_may_mix_folders_and_archives(tmp_path):
    """A zip file is one submission; what cannot be opened gets a row with its reason."""
    tree(tmp_path / "c", [f"team-1/{NAME}", "team-2/notes.txt"])
    archive(tmp_path / "c" / "team-3.zip", [NAME])
    (tmp_path / "c" / "team-4.zip").write_bytes(b"PK\x03\x04 no more")
    (tmp_path / "c" / "team-5.zip").write_bytes(b"")  # an upload that was interrupted
    archive(tmp_path / "c" / "two.zip", [f"{name}/{NAME}" for name in "ab"])
    found = {h.id: h for h in hand_ins(tmp_path, tmp_path / "c")}
    assert list(found) == ["team-1", "team-2", "team-3", "team-4", "team-5", "two"]
    assert opened(tmp_path, found["team-3"]) == [NAME]
    for name, word in (
        ("team-2", "'notes.txt'"),
        ("team-4", "'team-4.zip': not a complete"),
        ("team-5", "'team-5.zip': is empty"),
        ("two", "which one"),
    ):
        assert word in why_not(tmp_path, found[name])
    assert [h.id for h in hand_ins(tmp_path, tmp_path / "c" / "team-5.zip")] == ["team-5"]


@pytest.mark.parametrize("name", ["t.tar.gz", "t.tgz", "t.7z", "t.rar", "t.tar"])
def test_an_archive_of_another_format_gets_a_row(tmp_path, name):
    """Inside a team's folder, an archive in a format other than zip is taken for a backup."""
    tree(tmp_path / "c", [f"a/{NAME}", f"b/lab/{NAME}", name, f"b/{name}"])
    found = {h.id: h for h in hand_ins(tmp_path, tmp_path / "c")}
    assert sorted(found) == ["a", "lab", "t"]
    assert f"{name}' " in why_not(tmp_path, found["t"])


@pytest.mark.parametrize("beside", [(), ("figures/bode.png",), ("notes.md",)])
def test_a_team_without_its_file_keeps_its_name(tmp_path, beside):
    """A team without `submission.toml` gets a row with the team's name, not its data folder's."""
    for where in ("c/team-7", "alone", "section/only/team-7"):
        tree(tmp_path / where, ("data/step.csv", *beside))
    tree(tmp_path / "c", [f"a/{NAME}"])
    for where, ids in (("c", ["a", "team-7"]), ("alone", ["alone"]), ("section", ["team-7"])):
        assert [h.id for h in hand_ins(tmp_path, tmp_path / where)] == ids


def test_folders_of_results_are_not_graded(tmp_path):
    """Folders with earlier results are not graded as submissions, and a message names them."""
    made = ("class.html", "feedback/.made.json", "feedback/a/feedback.html", "gradescope/a/x")
    tree(tmp_path / "c", (f"a/{NAME}", *made))
    tree(tmp_path / "c" / "grades", made)
    told = []
    found = find_hand_ins([tmp_path / "c"], scratch=tmp_path / "scratch", say=told.append)
    assert [h.id for h in found] == ["a"]
    assert [text.split("'")[1] for text in told] == ["c/feedback", "c/grades", "c/gradescope"]


@pytest.mark.skipif(sys.platform == "win32", reason="links and pipes need rights on Windows")
def test_links_and_pipes_are_not_followed(tmp_path):
    """Links and pipes in a submission are not read; a linked folder in a class gets a row."""
    secret = tree(tmp_path / "ours", ["secret.csv"])
    folder = tree(tmp_path / "c/team/", [NAME])
    (folder / "data").symlink_to(secret)
    (folder / "link.csv").symlink_to(secret / "secret.csv")
    os.mkfifo(folder / "pipe.csv")
    (tmp_path / "c" / "elsewhere").symlink_to(secret)
    linked, team = hand_ins(tmp_path, tmp_path / "c")
    assert "a link" in linked.problem
    assert opened(tmp_path, team) == [NAME]
    assert len(digest(team.sources)) == 64


def test_an_empty_or_missing_folder_is_an_error(tmp_path):
    """An empty or missing folder is an error."""
    (tmp_path / "empty").mkdir()
    for name, why in (("empty", "nothing"), ("absent", "no such")):
        with pytest.raises(ConfigError, match=why):
            hand_ins(tmp_path, tmp_path / name)


@given(st.lists(st.text(min_size=1, max_size=30), min_size=1, max_size=6))
def test_any_name_gives_a_valid_id(tmp_path_factory, names):
    """For any name, the id is unique, printable, not too long, and stays inside its folder."""
    from pipeline.grading.intake.find import HandIn, _with_ids

    ids = [hand_in.id for hand_in in _with_ids([HandIn(id=name, parent="p") for name in names])]
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


def test_a_name_of_many_numbers_is_read_at_once():
    """Names of a million characters with many numbers are parsed without delay."""
    for part in ("_1", "_LATE_1", "_assignsubmission_", "anon_", "-1.a"):
        parse_name(part * (1_000_000 // len(part)) + "\n")


# ------------------------------------------------------------------------------ platforms


def test_a_canvas_download(tmp_path):
    """In a Canvas download, names, late marks and resubmissions are understood.

    Several loose files of one student make one submission.
    """
    inner = zip_bytes(tmp_path, ["lab3/submission.toml", "lab3/data/a.csv"])
    download = archive(
        tmp_path / "submissions.zip",
        {
            "doejane_1024_77001_team-07.zip": zip_bytes(tmp_path, [f"team-07/{NAME}", "team-07/x"]),
            "doejane_1024_77009_team-07-1.zip": zip_bytes(tmp_path, [f"team-07/{NAME}"]),
            "roeric_LATE_1025_77002_lab3.zip": inner,
            "poeann_1026_77003_lab3.zip": inner,
            "loose_1027_77004_submission.toml": TOML,
            "loose_1027_77005_step.csv": "1,2",
            "empty_1028_text.html": "<p>sorry</p>",
            "LATE_anon_x7Yb2_77006_lab3.zip": inner,  # from an anonymous assignment
        },
    )
    found = {h.id: h for h in hand_ins(tmp_path, download)}
    assert {name: (h.owner, h.days_late) for name, h in found.items()} == {
        "anon_x7Yb2-lab3": ("anon_x7Yb2 (canvas anonymous: LATE_anon_x7Yb2_77006_lab3.zip)", 1.0),
        "empty": ("empty (canvas 1028)", 0.0),
        "loose": ("loose (canvas 1027: loose_1027_77004_submission.toml)", 0.0),
        "poeann-lab3": ("poeann (canvas 1026: poeann_1026_77003_lab3.zip)", 0.0),
        "roeric-lab3": ("roeric (canvas 1025: roeric_LATE_1025_77002_lab3.zip)", 1.0),
        "team-07": ("doejane (canvas 1024: doejane_1024_77009_team-07-1.zip)", 0.0),
    }
    assert opened(tmp_path, found["team-07"]) == [NAME]  # only from the resubmission
    assert opened(tmp_path, found["loose"]) == ["data/step.csv", "step.csv", NAME]
    assert "no submission" in why_not(tmp_path, found["empty"])


def test_a_moodle_download(tmp_path):
    """A Moodle download has one folder for each student, which holds a zip file or the files."""
    download = archive(
        tmp_path / "Lab 3.zip",
        {
            "Jane Doe_1024_assignsubmission_file_/work.zip": zip_bytes(tmp_path, [NAME]),
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
    files = {f"assignment_9_export/submission_{n}/{NAME}": TOML for n in (77, 78)}
    files["assignment_9_export/submission_metadata.yml"] = metadata
    known, unknown = hand_ins(tmp_path, archive(tmp_path / "export.zip", files))
    assert (known.id, unknown.id) == ("Jane Doe, Ric Roe", "submission_78")
    assert known.owner == "Jane Doe, Ric Roe (gradescope 77)"
    assert (known.handed_in, unknown.handed_in) == ("2026-11-20T10:00:00-08:00", "")


def test_metadata_of_strangers_are_not_trusted(tmp_path):
    """Metadata are read only at the top of a download, where students cannot write.

    Nested YAML aliases are not expanded, so they cannot fill the memory.
    """
    own = "submission_1:\n  :submitters:\n  - :name: Nobody\n"
    files = {f"a/submission_1/{NAME}": TOML, "a/submission_metadata.yml": own, f"b/{NAME}": TOML}
    owners = [one.owner for one in hand_ins(tmp_path, tree(tmp_path / "c", files))]
    assert owners == ["", "submission_1 (gradescope 1)"]
    laughs = "".join(f"  - &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]\n" for i in range(1, 30))
    text = f"x:\n  - &l0 [ha]\n{laughs}submission_77:\n  :submitters:\n  - :name: *l29\n"
    files = {"submission_metadata.yml": f"{text}  :created_at: *l29\n", f"submission_77/{NAME}": ""}
    (found,) = hand_ins(tmp_path, tree(tmp_path / "d", files))
    assert (found.id, found.handed_in) == ("submission_77", "")


# ------------------------------------------------------------------------------- archives


@pytest.mark.parametrize("wrapped", ["", "class/", "term/class/"])
def test_a_refused_file_affects_only_its_own_submission(tmp_path, wrapped):
    """If a file in a class archive is refused, only the submission that contains it fails.

    The file gets no row of its own, unless its submission has no other files.
    """
    class_ = archive(tmp_path / "all.zip", [f"{wrapped}team-{n}/{NAME}" for n in range(3)])
    with zipfile.ZipFile(class_, "a") as more:
        for name in ("team-1/data/link.csv", f"team-7/{NAME}"):
            info = zipfile.ZipInfo(wrapped + name)
            info.create_system, info.external_attr = 3, 0o120777 << 16
            more.writestr(info, "/etc/passwd")
    found = {hand_in.id: hand_in.problem for hand_in in hand_ins(tmp_path, class_)}
    assert {name: why.endswith("a link") for name, why in found.items()} == {
        "team-0": False, "team-1": True, "team-2": False, "team-7": True,
    }  # fmt: skip
    assert sum(why == "" for why in found.values()) == 2


@pytest.mark.parametrize("kind", ["folders", "zips", "stored zips, early", "packed zips, early"])
def test_an_incomplete_class_archive_is_refused(tmp_path, kind):
    """If a class archive is incomplete, nobody is graded, wherever it ends.

    A single incomplete submission still gets a row.
    """
    files = {f"team-{n}/{name}": text for n in range(4) for name, text in FILES.items()}
    if kind != "folders":
        files = {f"team-{n}.zip": zip_bytes(tmp_path, FILES) for n in range(4)}
    how = zipfile.ZIP_DEFLATED if kind.startswith("packed") else zipfile.ZIP_STORED
    download = archive(tmp_path / "class.zip", files, how)
    whole = download.read_bytes()
    download.write_bytes(whole[: 200 if "early" in kind else len(whole) // 2])
    single = archive(tmp_path / "team-9.zip", [NAME])
    single.write_bytes(single.read_bytes()[:-30])
    with pytest.raises(ConfigError, match=r"'class\.zip': not"):
        hand_ins(tmp_path, single, download)
    (found,) = hand_ins(tmp_path, single)
    assert found.id == "team-9"


def test_a_zip_with_a_deleted_member_is_accepted(tmp_path):
    """A zip file's table of contents is valid, although deleted bytes are still in it."""
    taken = archive(tmp_path / "team-1.zip", ["draft.txt", NAME])
    with zipfile.ZipFile(taken, "a") as again:
        del again.filelist[0]
        again.comment = b"tidied"  # makes zipfile write the table of contents again
    (found,) = hand_ins(tmp_path, taken)
    assert opened(tmp_path, found) == [NAME]


def test_a_hostile_submission_in_a_download_fails_alone(tmp_path):
    """A hostile submission in a class download fails alone; all others are graded.

    The faults are paths that leave the folder, very deep folders, a password and broken bytes.
    """
    files = {f"team-{n}/{NAME}": TOML for n in range(3)}
    files |= {"../up/x": "", "evil-1/../../x": "", "evil-2/" + "a/" * 1_500 + "x": ""}
    files |= {"evil-3/locked.csv": "1", f"evil-4/{NAME}": "0" * 500}
    download = archive(tmp_path / "class.zip", files)
    raw = bytearray(download.read_bytes())
    contents = raw.find(b"PK\x01\x02")
    for at, flags in ((raw.find(b"evil-3/") - 30, 6), (raw.find(b"evil-3/", contents) - 46, 8)):
        raw[at + flags] |= 1  # marks the member as encrypted
    raw[raw.find(b"0" * 500) + 7] ^= 1  # makes the checksum wrong
    download.write_bytes(raw)
    found = {h.id: h.problem.rpartition(" ")[2] for h in hand_ins(tmp_path, download)}
    assert found == {f"team-{n}": "" for n in range(3)} | {
        "up": "archive", "evil-1": "archive", "evil-2": "deep", "evil-3": "password",
        "evil-4": "'evil-4/submission.toml')",
    }  # fmt: skip


def test_archives_in_archives_are_opened_to_a_limited_depth(tmp_path):
    """A zip file inside a zip file is opened, but not one that is ten levels deep."""
    content = zip_bytes(tmp_path, [NAME])
    for depth in range(1, 11):
        content = zip_bytes(tmp_path, {"inner.zip": content})
        (found,) = hand_ins(tmp_path, archive(tmp_path / f"a{depth}.zip", {"b.zip": content}))
        if depth == 1:
            assert opened(tmp_path, found) == [NAME]
        if depth == 10:
            assert "no submission" in why_not(tmp_path, found)
    beside = {"lab/notes.md": "", "lab.zip": zip_bytes(tmp_path, [NAME])}  # a folder of its name
    (found,) = hand_ins(tmp_path, archive(tmp_path / "own.zip", beside))
    assert opened(tmp_path, found) == [NAME]


# ------------------------------------------------------------------------- one submission


def test_two_submissions_at_one_depth_are_refused(tmp_path):
    """If a folder has two submissions at the same depth, both are named; a higher one is graded."""
    folder = tree(tmp_path / "t", [f"a/{NAME}", f"b/{NAME}"])
    with pytest.raises(SubmissionError, match=r"'a/submission\.toml' and 'b/"):
        open_submission([folder], tmp_path / "opened")
    tree(folder, [NAME])
    assert open_submission([folder], tmp_path / "again") == tmp_path / "again"


def test_a_recording_that_is_too_large_is_refused_and_not_missed(tmp_path):
    """If a recording is too large, the reason says so; it does not say that the file is missing."""
    team = tree(tmp_path / "team-01", [NAME, "data/long.csv"])
    os.truncate(team / "data" / "long.csv", MAX_DATA_BYTES + 1)
    folder = open_submission([team], tmp_path / "opened")
    assert f"{MAX_DATA_BYTES + 1:,}" in str(file_problem(folder, "data/long.csv"))


def test_too_many_files_are_refused_with_one_reason(tmp_path, monkeypatch):
    """The limit is the same on every machine, and for all archives of a submission together."""
    monkeypatch.setattr("pipeline.grading.intake.files.HAND_IN", replace(HAND_IN, members=20))
    team = tree(tmp_path / "team", [NAME, *(f"junk/{i}" for i in range(20))])
    (tmp_path / "there").mkdir()
    unpacked(packed([team]), tmp_path / "there")
    part = zip_bytes(tmp_path, [str(i) for i in range(4)])
    nested = archive(tmp_path / "a.zip", {f"{i}.zip": part for i in range(10)})
    for number, (source, known) in enumerate(
        ((team, digest([team])), (tmp_path / "there", digest([team])), (nested, ""))
    ):
        with pytest.raises(SubmissionError, match=" files"):
            open_submission([source], tmp_path / f"open-{number}", digest=known)
    (team / "junk" / "7").unlink()
    assert open_submission([team], tmp_path / "again").joinpath(NAME).is_file()


def test_a_submission_is_unchanged_on_another_machine(tmp_path):
    """A submission sent to another machine has the same files and the same hash there."""
    folder = tree(tmp_path / "t", [NAME, "data/ü.csv", ".DS_Store"])
    unpacked(packed([folder]), tmp_path / "there")
    before = digest([folder])
    assert digest([tmp_path / "there"]) == before
    tree(folder, {"data/ü.csv": "2"})
    assert digest([folder]) != before
