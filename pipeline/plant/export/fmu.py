"""Export the model as an FMU: FMI 2.0 for co-simulation.

It contains sources and, if there is a compiler, a binary.

Reference: Functional Mock-up Interface for Model Exchange and Co-Simulation, version 2.0.4.
"""

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from pipeline import __version__
from pipeline.plant.export.description import Description
from pipeline.plant.export.sources import c_sources, render

_COMPILERS = ("cc", "gcc", "clang")
_PATIENCE = 120.0  # s; compiling normally takes 0.3 s
# earliest date in a zip file; a fixed date gives the same bytes each time
_EPOCH = (1980, 1, 1, 0, 0, 0)
_LIBRARY = {"linux": "so", "darwin": "dylib", "win32": "dll"}
_SYSTEM = {"linux": "linux", "darwin": "darwin", "win32": "win"}


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A variable in modelDescription.xml; `member` is its name in the C structure."""

    index: int
    name: str
    member: str
    meaning: str
    unit: str
    causality: str
    variability: str = "continuous"
    start: str = ""


def fmu(description: Description) -> tuple[bytes, bool]:
    """Return `model.fmu`, and whether it has a binary for this computer."""
    sources = c_sources(description)
    variables = _variables(description)
    settable = sum(v.causality in ("input", "parameter") for v in variables)
    # The GUID in binary and description must be the same, because tools compare them.
    known = "".join([*sources.values(), *map(repr, variables), __version__])
    guid = f"{{{hashlib.sha256(known.encode()).hexdigest()[:32]}}}"
    values = {"guid": guid, "variables": variables, "settable": settable, "version": __version__}
    sources |= {name: render(name, description, **values) for name in ("fmi2.h", "fmi2.c")}
    files: dict[str, str | bytes] = {
        "modelDescription.xml": render("modelDescription.xml", description, **values),
        **{f"sources/{name}": text for name, text in sources.items()},
    }
    binary = compile_library(sources)
    if binary is not None:
        bits = 64 if sys.maxsize > 2**32 else 32
        system = _SYSTEM[sys.platform]
        files[f"binaries/{system}{bits}/model.{_LIBRARY[sys.platform]}"] = binary
    return _zip(files), binary is not None


def _variables(description: Description) -> list[Variable]:
    units, found = description.units, []

    def add(name: str, member: str, meaning: str, unit: str, causality: str, **more: str) -> None:
        index = len(found) + 1
        found.append(
            Variable(
                index=index, name=name, member=member, meaning=meaning, unit=unit,
                causality=causality, **more,
            )
        )  # fmt: skip

    fixed = {"causality": "parameter", "variability": "fixed"}
    tunable = {"causality": "parameter", "variability": "tunable"}
    sign_note = "; the recordings count it the other way" if description.sign_reversed else ""
    add("u", "u", f"input, constant during a step{sign_note}", units.input, "input", start="0")
    for i, start in enumerate(description.rest, start=1):
        meaning = f"start position of cart {i}"
        add(f"x{i}_start", f"start[{i - 1}]", meaning, units.position, start=start, **fixed)
    for p in description.parameters:
        add(p.name, f"model.p.{p.name}", p.meaning, p.unit, start=p.text, **tunable)
    for i in range(1, description.n + 1):
        add(f"x{i}", f"model.y[{i - 1}]", f"reading of sensor {i}", units.position, "output")
    speed = f"{units.position}/s"
    for at, body in enumerate(description.bodies):
        if at >= description.n:
            meaning = f"position of {body.meaning}"
            add(f"x{body.suffix}", f"model.x[{at}]", meaning, units.position, "local")
        add(f"v{body.suffix}", f"model.v[{at}]", f"velocity of {body.meaning}", speed, "local")
    for at, bristle in enumerate(description.bristles):
        add(bristle.name, f"model.z[{at}]", f"bend, -1 to 1: {bristle.title}", "", "local")
    if description.lag:
        add("u_lag", "model.lagged", "input after the lag", units.input, "local")
    return found


def compile_library(sources: Mapping[str, str]) -> bytes | None:
    """Return the sources compiled to a library for this computer; None if there is no compiler."""
    compiler = next(filter(None, map(shutil.which, _COMPILERS)), None)
    if compiler is None or sys.platform not in _LIBRARY:
        return None
    with tempfile.TemporaryDirectory() as name:
        for file, text in sources.items():
            (Path(name) / file).write_text(text, encoding="utf-8")
        library = f"model.{_LIBRARY[sys.platform]}"
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden", "-o", library]
        command = [compiler, *options, "model.c", "fmi2.c", "-lm"]
        try:
            done = subprocess.run(command, cwd=name, capture_output=True, timeout=_PATIENCE)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return (Path(name) / library).read_bytes() if done.returncode == 0 else None


def _zip(files: Mapping[str, str | bytes]) -> bytes:
    stream = BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), content, zipfile.ZIP_DEFLATED)
    return stream.getvalue()
