"""Simulated submissions, honest or spoilt, and classes in which each team makes one mistake.

Recordings are made by `cartlab simulate`. Everything else is an edit of the files, so that no
module of cartlab decides what is wrong in them.
"""

import math
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

Edit = Callable[[Path], None]
Channels = dict[str, Any]
_COUNT = 0.00227  # encoder step of the simulated bench, cm


@dataclass(frozen=True, kw_only=True)
class Made:
    """A simulated submission.

    Attributes
    ----------
    hide : hidden effects, as `cartlab simulate --hide` takes them.
    edits : what is changed in its files afterwards.
    """

    name: str
    carts: int
    seed: int
    hide: tuple[str, ...] = ()
    edits: tuple[Edit, ...] = ()

    def command(self, folder: Path) -> tuple[str | Path, ...]:
        """Return the command that writes the honest submission."""
        hidden = (word for effect in self.hide for word in ("--hide", effect))
        who = ("--preset", f"throne-{self.carts}dof", "--seed", str(self.seed), "--reported")
        return ("simulate", *who, *hidden, "--out", folder)


# -------------------------------------------------------------------------------- edits of files


def recording(name: str, change: Callable[[Channels], None]) -> Edit:
    """Change the channels (time, input, x1, …) of a recording, or of all whose name fits."""

    def edit(folder: Path) -> None:
        for file in sorted((folder / "data").glob(f"{name}.csv")):
            heading, *rows = file.read_text(encoding="utf-8").splitlines()
            values = np.array([row.split(",") for row in rows], dtype=float).T
            channels = dict(zip(heading.split(","), values, strict=True))
            change(channels)
            lines = (
                ",".join(f"{v:.10g}" for v in row) for row in np.transpose([*channels.values()])
            )
            file.write_text("\n".join([heading, *lines]) + "\n", encoding="utf-8", newline="\n")

    return edit


def text(change: Callable[[Any], None]) -> Edit:
    """Change the document of submission.toml."""

    def edit(folder: Path) -> None:
        file = folder / "submission.toml"
        document = tomlkit.parse(file.read_text(encoding="utf-8"))
        change(document)
        file.write_text(tomlkit.dumps(document), encoding="utf-8", newline="\n")

    return edit


def clipped(run: str, channel: str, *, side: int) -> Edit:
    """Clip a channel at 60 % of its largest value on one side."""

    def clip(channels: Channels) -> None:
        x = side * channels[channel]
        channels[channel] = side * np.minimum(x, round(0.6 * x.max(), 4))

    return recording(run, clip)


def scaled_recording(run: str, channel: str, factor: float) -> Edit:
    """Multiply a channel by a factor."""

    def scale(channels: Channels) -> None:
        channels[channel] = factor * channels[channel]

    return recording(run, scale)


def exchanged(channels: Channels) -> None:
    """Swap the first two carts."""
    channels["x1"], channels["x2"] = channels["x2"], channels["x1"]


def stuck(channels: Channels) -> None:
    """Let the first encoder stick for 60 samples where the cart is fastest."""
    x = channels["x1"]
    start = int(np.argmax(np.abs(np.diff(x))))
    x[start : start + 60] = x[start]


def coarse(channels: Channels) -> None:
    """Round all positions to 0.05 cm, and add no noise."""
    for name in channels:
        if name.startswith("x"):
            channels[name] = 0.05 * np.round(channels[name] / 0.05)


def cut(run: str) -> Edit:
    """Keep the first half of a file, and break its last line."""

    def edit(folder: Path) -> None:
        file = folder / "data" / f"{run}.csv"
        lines = file.read_text(encoding="utf-8").splitlines()
        half = lines[: len(lines) // 2]
        half[-1] = half[-1].partition(",")[0]
        file.write_text("\n".join(half) + "\n", encoding="utf-8", newline="\n")

    return edit


def copied(source: str, target: str) -> Edit:
    """Replace a recording by another one, `NAME` of the same team or `TEAM/NAME`."""

    def edit(folder: Path) -> None:
        team, _, run = source.rpartition("/")
        home = folder.parent / team if team else folder
        shutil.copyfile(home / "data" / f"{run}.csv", folder / "data" / f"{target}.csv")

    return edit


def without(*kinds: str, keep_every: int = 0) -> Edit:
    """Remove the recordings of these kinds; of the others' n, keep each `keep_every`-th."""

    def remove(document: Any) -> None:
        listed = document["experiments"]
        of_kinds = [run for run in listed if run["kind"] in kinds]
        for number, run in enumerate(of_kinds):
            if not keep_every or number % keep_every:
                listed.remove(run)

    return text(remove)


def setting(table: str, key: str, value: Any) -> Edit:
    """Set one key of a table."""

    def change(document: Any) -> None:
        document[table][key] = value

    return text(change)


def other_frequency(document: Any) -> None:
    """State a wrong frequency for the fifth dwell."""
    run = [one for one in document["experiments"] if one["kind"] == "sine"][4]
    run["frequency"] = round(1.3 * run["frequency"], 3)


def second_loop(folder: Path) -> None:
    """Hand in a second closed-loop run, before the good one, that fits no model."""
    shutil.copyfile(folder / "data/control.csv", folder / "data/acontrol.csv")
    last = (
        (folder / "data/control.csv").read_text(encoding="utf-8").split("\n", 1)[0].split(",")[-1]
    )
    scaled_recording("acontrol", last, 1.8)(folder)

    def add(document: Any) -> None:
        listed = document["experiments"]
        run = tomlkit.item(dict(listed[-1]), _parent=listed)
        run["id"], run["file"] = "acontrol", "data/acontrol.csv"
        listed.append(run)

    text(add)(folder)


# ----------------------------------------------------------------------- mistakes in the numbers


def times(pattern: str, factor: float, *, tables: str = "initial final") -> Edit:
    """Multiply all reported numbers whose names fit the pattern, typed with 4 digits."""

    def change(document: Any) -> None:
        for table in tables.split():
            numbers = document["reported"][table]
            for name in list(numbers):
                if re.fullmatch(pattern, name):
                    numbers[name] = float(f"{factor * numbers[name]:.4g}")

    return text(change)


def typed(table: str, pattern: str, *, digits: int) -> Edit:
    """Type the numbers whose names fit the pattern with fewer digits: 20 as 2e1."""

    def change(document: Any) -> None:
        numbers = document["reported"][table]
        for name in list(numbers):
            if re.fullmatch(pattern, name):
                numbers[name] = tomlkit.value(f"{float(numbers[name]):.{digits - 1}e}")

    return text(change)


def swapped(*symbols: str) -> Edit:
    """Swap the numbers of carts 1 and 2 in both tables."""

    def change(document: Any) -> None:
        for table in ("initial", "final"):
            numbers = document["reported"][table]
            for s in symbols:
                one, two = numbers[f"{s}_1"], numbers[f"{s}_2"]
                numbers[f"{s}_1"], numbers[f"{s}_2"] = float(two), float(one)

    return text(change)


def no_fit(document: Any) -> None:
    """Copy the initial table as the final one."""
    tables = document["reported"]
    for name in tables["final"]:
        tables["final"][name] = float(tables["initial"][name])


def peak_for_level(folder: Path) -> None:
    """Read every gain at the largest excursion after the first edge of the first step."""
    heading, *rows = (folder / "data/step-1.csv").read_text(encoding="utf-8").splitlines()
    values = np.array([row.split(",") for row in rows], dtype=float).T
    channels = dict(zip(heading.split(","), values, strict=True))
    on = np.flatnonzero(channels["input"])
    size = channels["input"][on[0]]

    def change(document: Any) -> None:
        numbers = document["reported"]["initial"]
        for name in (one for one in numbers if one.startswith("K")):
            x = channels[f"x{name[2:] or 1}"]
            numbers[name] = float(f"{((x[on[0] : on[-1]] - x[0]) / size).max():.3g}")

    text(change)(folder)


def reported(table: str, key: str, change: Callable[[Any], Any]) -> Edit:
    """Change one reported value; None removes it."""

    def edit(document: Any) -> None:
        tables = document["reported"]
        value = change(tables[table][key].unwrap())
        if value is None:
            del tables[table][key]
        else:
            tables[table][key] = value

    return text(edit)


def wrong_sign(A: Any) -> Any:
    """Reverse the sign of the first stiffness in a state matrix."""
    A[1][0] = -A[1][0]
    return A


def no_model(document: Any) -> None:
    """Leave out the state model."""
    del document["reported"]["state_space"]


_OMEGA, _GAINS = "omega_.*", "K.*"
_OWN_OMEGA, _OWN_ZETA = "omega_[12n]", "zeta(_[12])?"
TWO_PI = 2 * math.pi


def _gains(factor: float) -> Edit:
    return reported("feedback", "gains", lambda g: [float(f"{factor * one:.4g}") for one in g])


# What each team of a class does. The first team is the source of a copied recording.
MISTAKES: dict[str, tuple[Edit, ...]] = {
    "a-honest": (),
    "honest": (),
    "hertz": (times(_OMEGA, 1 / TWO_PI),),
    "hertz-initial": (times(_OMEGA, 1 / TWO_PI, tables="initial"),),
    "hertz-one": (times("omega_[1n]", 1 / TWO_PI, tables="final"),),
    "hertz-twice": (times(_OMEGA, TWO_PI),),
    "peak-count": (
        times(_OWN_OMEGA, 4 / 3, tables="initial"),
        times(_OWN_ZETA, 3 / 4, tables="initial"),
    ),
    "half-decrement": (times(_OWN_ZETA, 0.5, tables="initial"),),
    "twice-decrement": (times(_OWN_ZETA, 2.0, tables="initial"),),
    "log10": (times(_OWN_ZETA, math.log10(math.e), tables="initial"),),
    "peak-for-level": (peak_for_level,),
    "peak-to-peak": (times(_GAINS, 2.0),),
    "input-peak-to-peak": (times(_GAINS, 0.5),),
    "counts": (times(_GAINS, 1 / _COUNT),),
    "factor-of-ten": (times("K(_1)?", 10.0, tables="final"),),
    "swapped": (swapped("K", "omega", "zeta"),),
    "swapped-gains": (swapped("K"),),
    "no-fit": (text(no_fit),),
    "final-off": (times("K(_1)?", 1.3, tables="final"),),
    "final-slightly-off": (times("omega_[an]", 1.07, tables="final"),),
    "initial-off": (times("omega_[1n]", 1.13, tables="initial"),),
    "apart": (times("K(_1)?", 1.6, tables="initial"), without("step", "sine", "sweep")),
    "slightly-apart": (times("omega_[2n]", 1.22, tables="initial"),),
    "apart-in-two-digits": (
        typed("initial", "omega_[2n]", digits=2),
        times("omega_[2n]", 1.04, tables="final"),
        typed("initial", "K(_1)?", digits=1),
    ),
    "negative": (times("zeta(_a)?", -1.0, tables="final"),),
    "model-sign": (reported("state_space", "A", wrong_sign),),
    "model-missing": (text(no_model),),
    "gains-reversed": (_gains(-1.0),),
    "gains-large": (_gains(2.5),),
    "gains-small": (_gains(0.35),),
    "gains-small-and-alone": (_gains(0.15),),
    "prefilter": (reported("feedback", "prefilter", lambda f: round(1.3 * f, 5)),),
    "prefilter-one": (reported("feedback", "prefilter", lambda _: 1.0),),
    "claims": (
        reported("feedback", "overshoot_percent", lambda _: 16.0),
        reported("feedback", "settling_time", lambda s: round(1.5 * s, 2)),
    ),
    "number-missing": (reported("final", "omega_b", lambda _: None),),
    "loop-missing": (without("closed_loop"),),
    "two-loops": (second_loop,),
    "dwells-missing": (without("sine"),),
    "few-dwells": (without("sine", keep_every=3),),
    "typed-wrong": (reported("final", "K_1", lambda _: "24.1.7"),),
    "copied": (copied("a-honest/decay-1a", "decay-1a"), copied("a-honest/decay-2b", "decay-2b")),
    "stuck": (recording("step-1", stuck),),
    "clipped": (clipped("sine-1?", "x1", side=-1),),
}
# A class small enough for every test run: the teams make several mistakes each.
FEW_TEAMS: dict[str, tuple[Edit, ...]] = {
    "a-honest": (),
    "apart": (*MISTAKES["apart-in-two-digits"], *MISTAKES["prefilter"]),
    "dwells-missing": MISTAKES["dwells-missing"],
    "twice": (
        *MISTAKES["hertz-twice"],
        *MISTAKES["gains-small"],
        clipped("sweep", "input", side=-1),
    ),
    "two-loops": (times(_GAINS, 1.22, tables="initial"), *MISTAKES["two-loops"]),
}
SPOILT: dict[str, tuple[Edit, ...]] = {
    "clipped-above": (clipped("sine-1?", "x1", side=1),),
    "clipped-below": (clipped("sine-1?", "x1", side=-1), clipped("sweep", "input", side=-1)),
    "exchanged": (recording("step-1", exchanged),),
    "all-exchanged": (recording("*", exchanged),),
    "input-reversed": (scaled_recording("step-2", "input", -1.0),),
    "stuck": (recording("step-1", stuck),),
    "cut": (cut("decay-1a"), cut("sine-03")),
    "ten-times": (scaled_recording("decay-1b", "x1", 10.0), scaled_recording("step-3", "x1", 10)),
    "other-frequency": (text(other_frequency),),
    "copied": (copied("decay-1a", "decay-1b"), copied("step-1", "step-2")),
    "other-springs": (setting("system", "springs", [True, True, True]),),
    "no-dwells": (without("sine"),),
    "few-dwells": (without("sine", keep_every=4),),
    "decays-only": (without("sine", "step", "sweep", "closed_loop"),),
    "no-steps": (without("step"),),
    "coarse": (recording("*", coarse),),
    "low-limit": (setting("design", "input_limit", 0.08),),
    "fast": (setting("design", "settling_time", 0.25), setting("design", "overshoot_percent", 1.0)),
}
HIDDEN = {
    "coulomb": (1, "coulomb_friction:cart=1"),
    "coulomb-2": (2, "coulomb_friction:cart=2"),
    "stiction": (1, "stiction:cart=1"),
    "drag": (1, "quadratic_drag:cart=1"),
    "cubic": (2, "cubic_spring:spring=2"),
    "slack": (2, "slack_spring:spring=2"),
    "stop": (1, "end_stop:cart=1"),
    "stop-2": (2, "end_stop:cart=2"),
    "backlash": (1, "backlash"),
    "dead-zone": (1, "dead_zone"),
    "saturation": (1, "saturation"),
    "delay": (2, "input_delay"),
    "lag": (1, "actuator_lag"),
    "sensor": (2, "sensor_gain:cart=2"),
    "cogging": (1, "cogging"),
    "offset": (1, "force_offset:cart=1"),
}
