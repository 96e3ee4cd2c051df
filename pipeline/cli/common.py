"""The application: errors, exit codes, messages and the options that commands share.

Data goes to `--out` or stdout, messages to stderr. Exit status: 0 done, 1 checks failed, 2 cannot
run.
Each command imports its own heavy modules, so that `--help` answers at once.
"""

import errno
import os
import re
import shutil
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.exceptions import TyperException

from pipeline import __version__
from pipeline.cli import INTERRUPTED, STOPPED
from pipeline.errors import PipelineError, is_disk_full, is_file_fault
from pipeline.words.progress import Progress

# `cartlab --help` lists the commands by role, in this order; the others are under MORE.
ROLES = {
    "Students": ("fill", "inspect", "report", "check", "gap", "desk"),
    "TAs": ("grade", "override", "adjust", "hold", "history", "export", "check-rubric"),
    "Instructors": ("new", "plan", "acquire", "explore", "simulate", "solution", "new-rubric"),
}
MORE = "More"


class _ByRole(TyperGroup):
    """The commands, listed by the role of the user."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one list of commands for each role."""
        of_roles = {name for names in ROLES.values() for name in names}
        others = tuple(name for name in self.commands if name not in of_roles)
        width = formatter.width - max(map(len, self.commands)) - 6
        for role, names in {**ROLES, MORE: others}.items():
            with formatter.section(role):
                formatter.write_dl(
                    [(name, self.commands[name].get_short_help_str(width)) for name in names]
                )


app = typer.Typer(
    name="cartlab",
    cls=_ByRole,
    help="Lab reports and identification for carts on springs: from raw bench data to the plant, "
    "a controller and a report.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

FIRST_WORD, _LAST_PAUSE = 2.0, 60.0  # s between messages: the first pause, and the longest
PIPE_WIDTH = 80  # characters in a line that is not for a terminal
_JOINT, _UNBROKEN = re.compile(r" (?=[=→])|(?<=[=→]) "), "\u00a0"
_SENTENCE = re.compile(r".+?[.?!](?= [A-Z]|$)")

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A submission folder.")]
Preset = Annotated[str | None, typer.Option(help="throne-1dof, throne-2dof or throne-3dof.")]
Model = Annotated[
    Path | None, typer.Option(help="Use the chain and effects of this gap.json, not a preset.")
]
Hide = Annotated[
    list[str] | None,
    typer.Option(
        metavar="EFFECT[:key=value,…]",
        help="Hide an effect (see `cartlab effects`); may be repeated. `simulate --vary` "
        "draws one of EFFECT/EFFECT/…",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]


def run() -> None:
    """Run the command line.

    Print an error that the user can fix as one line, with exit status 2.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            set_encoding(stream, platform=sys.platform)
    try:
        status = app(sys.argv[1:] or ["--help"], standalone_mode=False)
        # Typer turns Ctrl-C into this status; a command that has said so raises SystemExit.
        if status == INTERRUPTED:
            say(STOPPED)
        sys.exit(status)
    except TyperException as error:  # a wrong option or argument
        _fail(_misuse(error))
    except PipelineError as error:
        _fail(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}{_hint(error)}")


def set_encoding(stream: TextIOWrapper, *, platform: str) -> None:
    """Let a console show a character that it lacks as its number; on Windows, pipes get UTF-8.

    There they would get the code page of the user's language, in which no program expects JSON.
    """
    stream.reconfigure(errors="backslashreplace")
    chosen = os.environ.get("PYTHONIOENCODING") or stream.isatty()
    if platform == "win32" and not chosen:
        stream.reconfigure(encoding="utf-8", newline="\n")


def _hint(error: OSError) -> str:
    """Return what to do about a file that cannot be read or written."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return "; can you read and write it? Commands with --out can write to another place"
    if is_disk_full(error) or is_file_fault(error) or error.errno == errno.EROFS:
        return ": choose another place, for example with --out"
    return ""


def _misuse(error: TyperException) -> str:
    """Return what is wrong with an option or an argument, and which help to read."""
    from pydantic import ValidationError

    from pipeline.submission.toml import refusal

    if isinstance(error.__cause__, ValidationError):
        error.message = refusal(error.__cause__.errors()[0])
    context = getattr(error, "ctx", None)
    command = f"{context.info_name} " if context and context.parent else ""
    return f"{error.format_message().rstrip('.')} (cartlab {command}--help explains)"


def _fail(message: str) -> None:
    say(f"cartlab: {message}")
    sys.exit(2)


def say_briefly(text: str, *, most: int, more: str) -> None:
    """Print a long message in at most `most` lines of the terminal's width; see `brief_lines`."""
    width = (
        shutil.get_terminal_size((PIPE_WIDTH, 24)).columns if sys.stderr.isatty() else PIPE_WIDTH
    )
    for line in brief_lines(text, width=width, most=most, more=more):
        say(line)


def brief_lines(text: str, *, width: int, most: int, more: str) -> list[str]:
    """Return paragraphs and list items as at most `most` lines of `width` characters.

    If they are too long, each is cut to its first sentence, then items to two lines, then to one.
    At last, items of the longest list are left out, but neither its first nor its last.

    Parameters
    ----------
    text : one paragraph or one item ("- …") a line.
    more : where the rest is, such as "the page".
    """
    paragraphs = text.splitlines()
    for cut in (None, 0, 2, 1):
        if cut == 0:
            paragraphs = [_first_sentence(one) for one in paragraphs]
        lines = [_wrapped(one, width=width, most=cut or most) for one in paragraphs]
        if sum(map(len, lines)) <= most:
            return [line for one in lines for line in one]
    lists = _lists(paragraphs)
    left_out = 0
    while sum(map(len, lines)) + 1 > most and (longest := max(lists, key=len, default=[])):
        lines[longest.pop(-2 if len(longest) > 2 else -1)] = []
        left_out += 1
    shown = [line for one in lines for line in one]
    return [*shown, f"- {left_out} more: see {more}"] if left_out else shown


def _first_sentence(paragraph: str) -> str:
    found = _SENTENCE.match(paragraph)
    return found[0] if found else paragraph


def _wrapped(paragraph: str, *, width: int, most: int) -> list[str]:
    """Return a paragraph in at most `most` lines, without breaking names and paths."""
    item = paragraph.startswith("- ")
    lines = textwrap.wrap(
        _JOINT.sub(_UNBROKEN, paragraph),
        width,
        subsequent_indent="  " if item else "",
        break_long_words=False,
        break_on_hyphens=False,
        max_lines=most if item else None,
        placeholder=" …",
    )
    return [line.replace(_UNBROKEN, " ") for line in lines]


def _lists(paragraphs: Sequence[str]) -> list[list[int]]:
    """Return the places of the items of each list."""
    lists: list[list[int]] = [[]]
    for i, one in enumerate(paragraphs):
        if one.startswith("- "):
            lists[-1].append(i)
        elif lists[-1]:
            lists.append([])
    return lists


def say(text: str) -> None:
    """Print a message to stderr without control characters, which a file name might contain."""
    typer.echo("".join(c if c.isprintable() or c == "\n" else " " for c in text), err=True)


@contextmanager
def progress_line() -> Iterator[Progress]:
    """Show progress; print a message if Ctrl-C ends the work."""
    with ctrl_c_says(lambda: say(STOPPED)) as check_stop:
        with _shown_line() as show:

            def check_and_show(text: str) -> None:
                check_stop()
                show(text)

            yield check_and_show


@contextmanager
def _shown_line() -> Iterator[Progress]:
    if not sys.stderr.isatty():
        with log_progress() as show:
            yield show
        return
    from rich import progress
    from rich.console import Console

    # A recording may be called "[b]"; that is not markup.
    text_column = progress.TextColumn("{task.description}", markup=False)
    columns = progress.SpinnerColumn(), text_column, progress.TimeElapsedColumn()
    with progress.Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        task = shown.add_task("starting", total=None)
        yield lambda text: shown.update(task, description=text)


@contextmanager
def log_progress() -> Iterator[Progress]:
    """Print progress after 2 s, then at doubling intervals of at most a minute.

    This is for a log, whose lines cannot be overwritten: short work prints nothing, long work
    prints a few lines.
    """
    now, over, began = ["starting"], threading.Event(), time.monotonic()

    def follow() -> None:
        pause = FIRST_WORD
        while not over.wait(pause):
            say(f"{now[0]} … {time.monotonic() - began:.0f} s")
            pause = min(2 * pause, _LAST_PAUSE)

    following = threading.Thread(target=follow, daemon=True)
    following.start()
    try:
        yield lambda text: now.__setitem__(0, text)
    finally:
        over.set()
        following.join()


def _version(value: bool) -> None:
    if value:
        typer.echo(f"cartlab {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass


@contextmanager
def ctrl_c_says(say: Callable[[], None]) -> Iterator[Callable[[], None]]:
    """Call `say` when Ctrl-C is pressed; yield a function that then ends the work.

    A library may turn an interrupt into a different error. And Python drops an interrupt in the
    callback of a weak reference, for example during an import. In both cases, the next call of the
    yielded function ends the work.
    """
    pressed = False

    def stop(*_: object) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, stop)
    try:
        yield check
        check()
    except BaseException:
        if not pressed:
            raise
        say()
        sys.exit(INTERRUPTED)
    finally:
        signal.signal(signal.SIGINT, before)
