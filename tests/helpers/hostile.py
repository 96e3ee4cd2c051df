"""A class of a hundred entries that are malicious submissions or look like them.

Every entry is a folder or an archive in the class's folder. Sizes, depths and the spoilt file
depend on the seed.
"""

import io
import os
import pickle
import random
import re
import socket
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import scipy.io

from tests.helpers.poison import poisoned, zipped
from tests.helpers.recordings import package, sheet_xml, tdms_of

SECRET = "root:x:0:0:the-secret-outside"  # content of a file outside the class; must not leak
Files = Mapping[str, bytes]

_SCRIPT = "<script>alert(1)</script>"
_IMAGE = '"><img src=http://evil.example/x onerror=alert(1)>'
_TYPST = '#import "/etc/passwd": *; #read("/etc/passwd") $ x $ *b* <label> @ref \\'
_FORMULA = '=HYPERLINK("http://evil.example","a")'
_AUTHOR = r"(?<=\[\[authors\]\]\n)id = .*\n"
_HEAD = "version = 1\n[system]\ncarts = 1\n"
_STEP = '[[experiments]]\nid = "a"\nkind = "step"\nfile = "{}"\n'


def write_hostile(
    school: Path, good: Files, *, seed: int, every: int = 1, drawn: int = 0
) -> list[str]:
    """Write the hostile submissions beside existing ones; return the names of the entries.

    Good submissions with one spoilt part take the longest to grade, so only one in `every` is
    written. `drawn` further submissions are spoilt at random, a third of them as archives.
    """
    rng = random.Random(seed)
    outside = school.parent / "outside"
    outside.mkdir()
    (outside / "secret.txt").write_text(SECRET, encoding="utf-8")
    (outside / "junk.txt").write_text("no recording\n", encoding="utf-8")
    before = {path.name for path in school.iterdir()}
    for number, (name, raw) in enumerate(_archives(good, rng).items()):
        (school / f"zip-{number:02d}-{name}.zip").write_bytes(raw)
    for number, (name, files) in enumerate(list(_spoilt(good, rng).items())[seed % every :: every]):
        _write(school / f"bad-{number:02d}-{name}", files)
    for name in _names(rng):
        _write(school / name, {"submission.toml": b"version = 1\n"})
    for number, (name, build) in enumerate(_places(outside).items()):
        folder = school / f"place-{number:02d}-{name}"
        _write(folder, good)
        build(folder)
    for name, make in _entries(school, outside).items():
        make(school / name)
    for number in range(drawn):
        files = poisoned(good, rng)
        if number % 3:
            _write(school / f"drawn-{number:03d}", files)
        else:
            (school / f"drawn-{number:03d}.zip").write_bytes(zipped(files, rng))
    return sorted({path.name for path in school.iterdir()} - before)


def _write(folder: Path, files: Files) -> None:
    for name, raw in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(raw)


# ----------------------------------------------------------------------------- archives


def _zip(members: Mapping[str, bytes], *, mode: int = 0, method: int = zipfile.ZIP_DEFLATED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, raw in members.items():
            info = zipfile.ZipInfo(name)
            info.external_attr = mode << 16
            archive.writestr(info, raw, method)
    return buffer.getvalue()


def _archives(good: Files, rng: random.Random) -> dict[str, bytes]:
    """Return archives that are bombs, contain paths outside, or are not archives at all."""
    zeros = bytes(rng.randrange(20_000_000, 30_000_000))
    whole = _zip(good)
    lying = _zip({"submission.toml": zeros[:3_000_000]}).replace(
        struct.pack("<L", 3_000_000), struct.pack("<L", 10)
    )
    encrypted = bytearray(_zip({"submission.toml": b"secret"}))
    encrypted[6] |= 1
    encrypted[encrypted.find(b"PK\x01\x02") + 8] |= 1
    nested = _zip({f"{i}.zip": _zip({"z": zeros}) for i in range(3)})
    for _ in range(4):
        nested = _zip({f"{i}.zip": nested for i in range(8)})
    unknown = bytearray(_zip({"submission.toml": b"version = 1\n"}))
    for signature, at in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        where = unknown.find(signature) + at
        unknown[where : where + 2] = struct.pack("<H", 99)
    toml = {"submission.toml": good["submission.toml"]}
    links = {
        "a link": _zip({"submission.toml": b"/etc/passwd"}, mode=stat.S_IFLNK | 0o777),
        "a linked folder": _zip(toml | {"data": b"../../outside"}, mode=stat.S_IFLNK | 0o777),
        "a pipe": _zip(toml, mode=stat.S_IFIFO | 0o644),
        "a device": _zip(toml, mode=stat.S_IFCHR | 0o644),
        "a socket": _zip(toml, mode=stat.S_IFSOCK | 0o644),
    }
    escapes = {
        f"escape {i}": _zip(toml | {name: b"escaped"})
        for i, name in enumerate(
            ("../escaped", "a/../../../escaped", "/tmp/escaped", "C:\\escaped", "c:escaped",
             "..\\..\\escaped", "\\\\host\\share\\escaped", "./../escaped", "../submission.toml")
        )
    }  # fmt: skip
    return links | escapes | {
        "ratio": _zip(toml | {"data/zeros.csv": zeros}),
        "ratio, bzip2": _zip({"z": zeros}, method=zipfile.ZIP_BZIP2),
        "ratio, lzma": _zip({"z": zeros}, method=zipfile.ZIP_LZMA),
        "nested": nested,
        "members": _zip({f"{i}": b"" for i in range(2_500)}),
        "overlapping": overlapping(zeros, copies=300),
        "lying": lying,
        "contents": _zip({"x" * 60_000 + str(i): b"" for i in range(40)}),
        "encrypted": bytes(encrypted),
        "unknown method": bytes(unknown),
        "cut": whole[: rng.randrange(100, len(whole) // 2)],
        "cut end": whole[: -rng.randrange(1, 20)],
        "patched": whole[:5_000] + bytes(rng.randrange(256) for _ in range(400)) + whole[5_400:],
        "not": rng.randbytes(3_000),
        "nothing": b"",
        "end only": b"PK\x05\x06" + bytes(18),
        "no members": _zip({}),
        "deep": _zip({"a/" * 1_500 + "submission.toml": b"version = 1\n"}),
        "two": _zip({"a/submission.toml": b"", "b/submission.toml": b""}),
        "file and folder": _zip(toml | {"data": b"", "data/step-1.csv": b""}),
        "cases": _zip({**good, "DATA/STEP-1.CSV": b"", "Submission.TOML": b"version = 2"}),
        "long name": _zip(toml | {"n" * 4_000: b""}),
        "reserved": _zip(toml | {"CON": b"", "aux.csv": b"", "data/nul": b""}),
    }  # fmt: skip


def overlapping(zeros: bytes, *, copies: int) -> bytes:
    """Return an archive in which many members share the same packed bytes."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(zeros) + packer.flush()
    crc = zlib.crc32(zeros)
    sizes = struct.pack("<LLL", crc, len(packed), len(zeros))
    local = struct.pack("<4s5H", b"PK\x03\x04", 20, 0, 8, 0, 33) + sizes
    local += struct.pack("<2H", 3, 0) + b"000" + packed
    contents = b""
    for i in range(copies):
        contents += struct.pack("<4s6H", b"PK\x01\x02", 20, 20, 0, 8, 0, 33) + sizes
        contents += struct.pack("<5H2L", 3, 0, 0, 0, 0, 0, 0) + f"{i:03d}".encode()
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, copies, copies, len(contents), len(local), 0)
    return local + contents + end


# ------------------------------------------------------------------------------ contents


def _spoilt(good: Files, rng: random.Random) -> dict[str, Files]:
    """Return submissions with content that no reader should trust."""
    toml = good["submission.toml"].decode()
    spoilt: dict[str, Files] = {}

    def text(name: str, content: str | bytes) -> None:
        raw = content.encode() if isinstance(content, str) else content
        spoilt[name] = {**good, "submission.toml": raw}

    def data(name: str, content: str | bytes, *, file: str = "step-1.csv") -> None:
        raw = content.encode() if isinstance(content, str) else content
        changed = toml.replace("data/step-1.csv", f"data/{file}")
        spoilt[name] = {**good, "submission.toml": changed.encode(), f"data/{file}": raw}

    text("giant number", f"{_HEAD}[reported.final]\nK = 1{'0' * rng.randrange(5_000, 9_000)}")
    for number in ("nan", "inf", "-inf", "1e400", "-1e400", "1e-400", "9" * 400, "1e99"):
        text(f"number {number[:6]}", toml.replace("K = 28.9", f"K = {number}"))
    text("giant carts", toml.replace("carts = 1\nsprings", f"carts = {10**12}\nsprings"))
    text("tiny per_count", toml.replace('unit = "cm"', 'unit = "cm", per_count = 1e-320'))
    text("tiny rate", toml.replace('note = "chirp', 'sample_rate = 1e-300\nnote = "chirp'))
    text("giant matrix", toml.replace("A = [[0, 1]", "A = [" + "[0, 1], " * 20_000 + "[0, 1]"))
    text("giant gains", toml.replace("gains = [0.002799", "gains = [1e99"))
    text("deep lists", "x = " + "[" * rng.randrange(20_000, 90_000))
    text("deep tables", "x = " + "{a = " * 5_000 + "1" + "}" * 5_000)
    text("deep keys", "a." * 5_000 + "b = 1")
    text("deep heads", "[" + "a." * 50_000 + "b]")
    text("large", toml + "# so large\n" * 200_000)
    text("one line", "title = '" + "A" * 900_000 + "'\n" + toml.split("\n", 2)[2])
    text("many runs", _HEAD + "".join(_STEP.format("data/step-1.csv") for _ in range(15_000)))
    text("many keys", _HEAD + "".join(f"k{i} = {i}\n" for i in range(60_000)))
    text("not text", b"\x00\x01\x02\xff\xfe")
    text("utf-16", toml.encode("utf-16"))
    text("half a letter", toml.encode() + b'\nx = "\xc3"')
    text("empty", "")
    text("script", _marked(toml, _SCRIPT))
    text("image", _marked(toml, _IMAGE))
    text("typst", _marked(toml, _TYPST))
    text("formula", _marked(toml, _FORMULA))
    text("formula, tab", _marked(toml, "\t+1+cmd|' /C calc'!A0"))
    text("formula, return", _marked(toml, "x\r=cmd|' /C calc'!A0;\u3000\u00ad\u200e=1+1"))
    text("bidi", _marked(toml, "\u202egnp.\u2066x\u200b\u200d\ufeff"))
    text("control", _marked(toml, "\x1b[31m\x07\x00red\r\n\x85\u2028"))
    for number, name in enumerate(("..", "CON", "", "x" * 300, "a/b", "-1+1")):
        text(f"author {number}", re.sub(_AUTHOR, f'id = "{name}"\n', toml))
        text(f"run {number}", toml.replace('id = "step-1"', f'id = "{name}"'))
    for number, file in enumerate(
        ("../../outside/secret.txt", "/etc/passwd", "..", "data", "", "C:\\x", "\\\\host\\x",
         "data/../../../outside/secret.txt", "file:///etc/passwd", "con", "data/" + "y" * 3_000)
    ):  # fmt: skip
        text(f"file {number}", _HEAD + _STEP.format(file.replace("\\", "\\\\")))
    text("file with NUL", _HEAD + _STEP.format("data/\\u0000.csv"))

    rows = good["data/step-1.csv"].decode().splitlines()
    middle = len(rows) // 2
    data("cell nan", "\n".join([*rows[:middle], "nan,nan,nan", *rows[middle:]]))
    data("cell 1e400", "\n".join([*rows[:middle], "1e400,1e400,-1e400", *rows[middle:]]))
    data("cells 1e308", "\n".join([rows[0], *(f"{i},1e308,-1e308" for i in range(500))]))
    data("backwards", "\n".join([rows[0], *rows[:0:-1]]))
    data("zeros", "\n".join([rows[0], *("0,0,0" for _ in rows)]))
    data("one row", "\n".join(rows[:2]))
    data("wide", ",".join(["time", *(f"x{i}" for i in range(100_000))]) + "\n" + "1," * 100_000)
    data("long line", rows[0] + "\n" + "1" * 5_000_000)
    data("markup", "\n".join([f"{rows[0]},{_SCRIPT},{_FORMULA}", *(f"{r},1,2" for r in rows[1:])]))
    data("binary", rng.randbytes(50_000))
    data("pickle", pickle.dumps(_Evil()), file="step.mat")
    data("pickle as text", pickle.dumps(_Evil(), protocol=0))
    mat = _mat()
    data("mat cut", mat[: rng.randrange(130, len(mat) - 10)], file="step.mat")
    data("mat junk", b"MATLAB 5.0 MAT-file" + rng.randbytes(4_000), file="step.mat")
    data("mat 7.3", b"MATLAB 7.3 MAT-file" + bytes(500) + b"\x89HDF\r\n\x1a\n", file="step.mat")
    data("mat bomb", _mat_bomb(), file="step.mat")
    far = '<row r="1048576"><c r="XFD1048576"><v>2</v></c></row></sheetData>'
    sheet = sheet_xml([["time", "input", "x1"], *([0.01 * i, 1.0, 0.5] for i in range(50))])
    data("workbook, far", package(sheet.replace("</sheetData>", far)), file="step.xlsx")
    data("workbook, entities", package(_LAUGHS + sheet), file="step.xlsx")
    data("workbook, bomb", package(sheet + " " * 30_000_000), file="step.xlsx")
    data("workbook, texts", package(sheet, texts='<sst uniqueCount="99999999999"/>'),
         file="step.xlsx")  # fmt: skip
    data("workbook, cut", package(sheet)[: rng.randrange(200, 900)], file="step.xlsx")
    tdms = tdms_of({"time": np.arange(50.0), "x1": np.arange(50.0)})
    data("tdms absurd", b"TDSm" + struct.pack("<IIQQ", 14, 4712, 2**62, 2**62), file="step.tdms")
    data("tdms segments", tdms + (b"TDSm" + bytes(24)) * 500_000, file="step.tdms")
    data("tdms patched", tdms[:60] + rng.randbytes(40) + tdms[100:], file="step.tdms")
    data("LabVIEW cut", b"LabVIEW Measurement\t\n" * 100_000, file="step.lvm")
    data("mat patched", mat[:200] + rng.randbytes(40) + mat[240:], file="step.mat")
    for name, notes in {
        "script": f"# {_SCRIPT}\n{_IMAGE}\n[x](javascript:alert(1))\n![x](http://evil.example/x)",
        "open": "<!--\n<style>*{display:none}\n<iframe src=//evil.example>",
        "quotes": "> " * 5_000 + "x",
        "lists": "".join("  " * i + "- x\n" for i in range(1_000)),
        "brackets": "[" * 50_000 + "]" * 50_000 + "(" * 50_000,
    }.items():
        spoilt[f"notes, {name}"] = {**good, "notes.md": notes.encode()}
    return spoilt


def _marked(toml: str, text: str) -> str:
    """Return a submission with this text in every place where a student may write."""
    quoted = '"' + "".join(
        c if c.isprintable() and c not in '"\\' else f"\\u{ord(c):04x}" for c in text
    ) + '"'  # fmt: skip
    unit = "".join(c for c in text if c.isprintable())[:40].replace("\\", "").replace('"', "'")
    for pattern, new in (
        (r"^title = .*$", f"title = {quoted}"),
        (r"^section = .*$", f"section = {quoted}"),
        (_AUTHOR, f"id = {quoted}\nname = {quoted}\n"),
        (r"^note = .*$", f"note = {quoted}"),
        (r'unit = "cm"', f'unit = "{unit}"'),
    ):
        toml, times = re.subn(pattern, lambda _, new=new: new, toml, flags=re.MULTILINE)
        assert times, pattern
    return toml


_LAUGHS = (
    '<!DOCTYPE w [<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))
    + "]>"
)


class _Evil:
    """An object that runs code if a careless reader unpickles it."""

    def __reduce__(self) -> tuple[Callable, tuple]:
        return os.system, ("touch /tmp/escaped",)


def _mat() -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {"data": np.ones((50, 3)), "cell": np.array([{}, 1], dtype=object)})
    return buffer.getvalue()


def _mat_bomb() -> bytes:
    """Return a MATLAB variable that claims 10^18 numbers, followed by compressed zeros."""
    size = struct.pack("<LL", 6, 8) + bytes([6]) + bytes(7)
    shape = struct.pack("<LLll", 5, 8, 2**30, 2**30)
    body = size + shape + struct.pack("<LL", 1, 1) + b"x" + bytes(7)
    body += struct.pack("<LL", 9, 2**31 - 8) + bytes(30_000_000)
    packed = zlib.compress(struct.pack("<LL", 14, len(body)) + body)
    head = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + struct.pack("<HH", 0x0100, 0x4D49)
    return head + struct.pack("<LL", 15, len(packed)) + packed


# --------------------------------------------------------------------------------- names


def _names(rng: random.Random) -> list[str]:
    """Return folder names that are markup, formulas, reserved, similar or very long."""
    names = [
        "<b>bold<", '" onload=alert(1) x="', "&lt;script&gt;", _FORMULA.replace("/", ""),
        "@SUM(A1)", "-1+1", "#include $x$ *b*", "CON", "aux.txt", "com1", "...", "a.", "a ", " a",
        "~$lock", "feedback", "javascript:alert(1)", "%2e%2e%2fescaped", "a?b", "a*b", "a:b",
        "x\ny", "\x1b[31m", "Jos\u00e9", "Jose\u0301", "TEAM", "team", "Team", "\u202egnp.exe",
        "te\u200bam", "\ufeffteam", "n" * 255, "\U0001f600" * 60,
        "\u00fc" * 120 + str(rng.randrange(10)), "'; DROP TABLE gradings;--",
    ]  # fmt: skip
    return [*names, os.fsdecode(b"not-utf8-\xff\xfe")]


# -------------------------------------------------------------------------------- places


def _places(outside: Path) -> dict[str, Callable[[Path], object]]:
    """Return changes after which a file of a good submission is not what it seems."""

    def instead(name: str, make: Callable[[Path], object]) -> Callable[[Path], None]:
        def build(folder: Path) -> None:
            (folder / name).unlink()
            make(folder / name)

        return build

    def linked_folder(folder: Path) -> None:
        (folder / "data").rename(outside / "moved")
        (folder / "data").symlink_to(outside / "moved")

    secret = outside / "secret.txt"
    return {
        "linked toml": instead("submission.toml", lambda p: p.symlink_to(secret)),
        "linked data": instead("data/step-1.csv", lambda p: p.symlink_to(secret)),
        "linked nowhere": instead("submission.toml", lambda p: p.symlink_to("nowhere")),
        "linked round": instead("data/step-1.csv", lambda p: p.symlink_to(p)),
        "linked folder": linked_folder,
        "loop": lambda folder: (folder / "data" / "up").symlink_to(folder),
        # A hard link looks like a copy: a regular file, to be read like any other.
        "hard link": instead("data/step-1.csv", lambda p: p.hardlink_to(outside / "junk.txt")),
        "pipe toml": instead("submission.toml", os.mkfifo),
        "pipe data": instead("data/step-1.csv", os.mkfifo),
        "socket data": instead("data/step-1.csv", _socket),
        "folder as file": instead("data/step-1.csv", Path.mkdir),
        "folder as toml": instead("submission.toml", Path.mkdir),
        "unreadable toml": lambda folder: (folder / "submission.toml").chmod(0),
        "unreadable data": lambda folder: (folder / "data" / "step-1.csv").chmod(0),
        "unreadable folder": lambda folder: (folder / "data").chmod(0),
        "unreadable": lambda folder: folder.chmod(0),
    }


def _socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # since the address of a socket must be short
    try:
        with socket.socket(socket.AF_UNIX) as opened:
            opened.bind(path.name)
    finally:
        os.chdir(here)


def _entries(school: Path, outside: Path) -> dict[str, Callable[[Path], object]]:
    """Return entries of a class's folder that are neither folders nor files."""
    return {
        "pipe.zip": os.mkfifo,
        "socket.zip": _socket,
        "linked.zip": lambda path: path.symlink_to(outside / "secret.txt"),
        "linked": lambda path: path.symlink_to(outside),
        "round": lambda path: path.symlink_to(path),
        "up": lambda path: path.symlink_to(school),
        "doe_1024_77001_pipe.zip": os.mkfifo,
    }
