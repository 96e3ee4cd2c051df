"""A hostile archive writes nothing outside its folder and is refused with a reason."""

import struct
import zipfile
from contextlib import suppress
from pathlib import PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SubmissionError
from pipeline.grading.intake.unpack import HAND_IN, UnpackLimits, member_names, unpack
from tests.helpers.hostile import overlapping

SMALL = UnpackLimits(members=20, total=100_000, ratio=200.0, directory=10_000)
BRIEF = UnpackLimits(total=1_000_000, directory=10_000)


def zipped(path, members, *, mode=None):
    """Write a zip file from names and texts; `mode` is the Unix mode of every member."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in members.items():
            info = zipfile.ZipInfo(name)
            if mode is not None:
                info.create_system, info.external_attr = 3, mode << 16
            archive.writestr(info, text, zipfile.ZIP_DEFLATED)
    return path


def files_below(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_files_are_unpacked_without_debris(tmp_path):
    """Files come out as packed, without the extra files of macOS and Windows."""
    members = {
        "team/submission.toml": "x",
        "team/data/step.csv": "1,2",
        "__MACOSX/team/submission.toml": "junk",
        "team/data/._step.csv": "junk",
        "team/data/_step.csv": "3,4",
        "team/.DS_Store": "junk",
        "team/Thumbs.db": "junk",
    }
    assert unpack(zipped(tmp_path / "a.zip", members), tmp_path / "out", limits=HAND_IN) == {}
    kept = ["team/data/_step.csv", "team/data/step.csv", "team/submission.toml"]
    assert files_below(tmp_path / "out") == kept


@pytest.mark.parametrize(
    "name", ["../x", "a/../../x", "/etc/x", "C:/x", "..\\x", "a\\..\\..\\x", "\\\\host\\share\\x"]
)
def test_a_path_that_leaves_the_archive_is_refused(tmp_path, name):
    """A member whose path leads outside the archive is not written; the other members are."""
    archive = zipped(tmp_path / "a.zip", {name: "evil", "good.txt": "good"})
    refused = unpack(archive, tmp_path / "in" / "out", limits=SMALL)
    assert "outside" in "".join(refused.values())
    assert files_below(tmp_path) == ["a.zip", "in/out/good.txt"]


@pytest.mark.parametrize("name", ["data/run:1.csv", "x.csv.", "a /x", "nul.csv", "COM1", "a?b"])
def test_a_name_that_is_invalid_on_windows_is_refused_there(tmp_path, monkeypatch, name):
    """A name that is not valid on Windows is refused there and accepted elsewhere."""
    packed = zipped(tmp_path / "a.zip", {name: "x", "good.txt": "good"})
    assert not unpack(packed, tmp_path / "here", limits=SMALL)
    monkeypatch.setattr("pipeline.grading.intake.unpack.sys.platform", "win32")
    (why,) = unpack(packed, tmp_path / "there", limits=SMALL).values()
    assert why.endswith("Windows")
    assert files_below(tmp_path / "there") == ["good.txt"]


@pytest.mark.parametrize(
    ("mode", "reason"), [(0o120777, "is a link"), (0o010644, "regular"), (0o020644, "regular")]
)
def test_links_pipes_and_devices_are_refused(tmp_path, mode, reason):
    """A link, pipe or device in an archive is refused, since only regular files may be written."""
    archive = zipped(tmp_path / "a.zip", {"t/x": "/etc/passwd"}, mode=mode)
    (refused,) = unpack(archive, tmp_path / "out", limits=SMALL).values()
    assert reason in refused
    assert files_below(tmp_path / "out") == []


@pytest.mark.parametrize(
    ("members", "limits", "reason"),
    [
        ({"zeros": "0" * 2_000_000}, SMALL, "unpacks to"),
        ({"zeros": "0" * 20_000_000}, HAND_IN, "200 times"),
        ({str(i): "" for i in range(21)}, SMALL, "20 files"),
    ],
)
def test_zip_bombs_are_stopped(tmp_path, members, limits, reason):
    """While a zip bomb is unpacked, limits on size, ratio and number of files stop it."""
    archive = zipped(tmp_path / "bomb.zip", members)
    with pytest.raises(SubmissionError, match=reason):
        unpack(archive, tmp_path / "out", limits=limits)
    written = sum(p.stat().st_size for p in tmp_path.rglob("*") if p.is_file() and p != archive)
    assert written <= min(limits.total, 10_000_000)


def test_the_64_bit_length_of_the_contents_is_limited_too(tmp_path):
    """A table of contents that is too long is refused even if only the 64-bit record says so."""
    archive = zipped(tmp_path / "a.zip", {"y" * 4_000 + str(i): "" for i in range(19)})
    with pytest.raises(SubmissionError, match="of contents"):
        unpack(archive, tmp_path / "plain", limits=BRIEF)
    raw = archive.read_bytes()
    at = raw.rfind(b"PK\x05\x06")
    size, start = struct.unpack_from("<LL", raw, at + 12)
    new = struct.pack("<4sQ2H2L4Q", b"PK\x06\x06", 44, 45, 45, 0, 0, 19, 19, size, start)
    new += struct.pack("<4sLQL", b"PK\x06\x07", 0, at, 1)
    old = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 1, 1, 46, start, 0)
    archive.write_bytes(raw[:at] + new + old)
    with zipfile.ZipFile(archive) as opened:
        assert len(opened.infolist()) == 19
    with pytest.raises(SubmissionError, match="of contents"):
        unpack(archive, tmp_path / "out", limits=BRIEF)
    assert member_names(archive, limits=BRIEF) == []


def forged_size(path):
    """Claim ten bytes for a member of three million."""
    raw = zipped(path, {"x": "0" * 3_000_000}).read_bytes()
    path.write_bytes(raw.replace(struct.pack("<L", 3_000_000), struct.pack("<L", 10)))


def encrypted(path):
    raw = bytearray(zipped(path, {"x": "secret"}).read_bytes())
    raw[6] |= 1  # the flags in the local header; below, those in the table of contents
    raw[raw.find(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(raw)


def packed_by(method):
    """Pack by a method that can take much longer to unpack than deflate."""

    def pack(path):
        with zipfile.ZipFile(path, "w", method) as archive:
            archive.writestr("submission.toml", "x")

    return pack


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (forged_size, r"a\.zip"),
        (encrypted, "encrypted"),
        (packed_by(zipfile.ZIP_BZIP2), "Deflate"),
        (packed_by(zipfile.ZIP_LZMA), "Deflate"),
        (lambda path: path.write_bytes(overlapping(bytes(100), copies=2)), "same bytes"),
        (lambda path: path.write_bytes(overlapping(bytes(100), copies=40)), "same bytes"),
    ],
)
def test_an_archive_of_a_dangerous_kind_is_refused(tmp_path, write, reason):
    """It is refused with its reason, before much of it is written."""
    write(tmp_path / "a.zip")
    with pytest.raises(SubmissionError, match=reason):
        unpack(tmp_path / "a.zip", tmp_path / "out", limits=SMALL)
    written = [path.stat().st_size for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert sum(written) <= 10


def test_unmarked_utf_8_names_are_recognised(tmp_path):
    """Names in UTF-8 are recognised even if the archive does not mark them as UTF-8.

    A letter and a combining accent become one character.
    """
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mu\u0308ller/x.txt", "1")  # u and a combining diaeresis
    raw = path.read_bytes()
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        where = raw.find(signature) + at
        raw = raw[:where] + b"\0\0" + raw[where + 2 :]  # clears the flag that marks UTF-8
    path.write_bytes(raw)
    assert member_names(path) == [PurePosixPath("m\u00fcller/x.txt")]
    unpack(path, tmp_path / "out", limits=SMALL)
    assert files_below(tmp_path / "out") == ["m\u00fcller/x.txt"]


@given(st.binary(max_size=400), st.integers(0, 300), st.binary(max_size=8))
def test_any_bytes_are_unpacked_or_refused(tmp_path_factory, junk, at, patch):
    """Whatever its bytes are, an archive is unpacked or refused with an error for the student."""
    folder = tmp_path_factory.mktemp("zip")
    good = zipped(folder / "good.zip", {"a/b.txt": "hello" * 20, "c.txt": "x"}).read_bytes()
    for number, raw in enumerate((junk, good[:at] + patch + good[at + len(patch) :], good[:-at])):
        path = folder / f"{number}.zip"
        path.write_bytes(raw)
        member_names(path)
        with suppress(SubmissionError):
            unpack(path, folder / str(number), limits=SMALL)
