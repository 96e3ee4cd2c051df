"""The command `doctor`: what is installed, what is missing, and where files are."""

import json
import platform
import shutil
import sys
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib import metadata as installed
from pathlib import Path

import typer

from pipeline import __version__
from pipeline.cli.common import AsJson, app

# The extras that matter to a user, and what each one adds.
_EXTRAS = {
    "cluster": "grade on several computers",
    "postgresql": "a gradebook in PostgreSQL",
    "jupyter": "the desk in JupyterLab",
    "courses": "the example assignments of nbgrader and otter-grader",
}
_PROGRAMS = {
    "C compiler": ("cc", "gcc", "clang", "cl"),
    "browser": ("chromium", "google-chrome", "chrome", "firefox", "msedge", "safari"),
}
_MODULES = {  # modules whose names differ from those of their packages
    "markdown-it-py": "markdown_it", "pyserial": "serial", "python-multipart": "python_multipart",
    "pyyaml": "yaml", "psycopg": "psycopg",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Package:
    """A package that cartlab needs or that an extra adds.

    Attributes
    ----------
    wanted : allowed versions.
    found : the installed version; "" if it is not installed.
    problem : why it cannot be used; "" if it can.
    """

    name: str
    wanted: str
    found: str
    problem: str


@dataclass(frozen=True, kw_only=True)
class Health:
    """The state of the installation.

    Attributes
    ----------
    package : the folder of the code.
    extras : the packages of each extra, by name of the extra. If one package has a problem, the
        extra counts as missing.
    programs : the path of each system program that cartlab uses; "" if it was not found.
    compiled : the folder of the compiled simulator; "" if no folder can be written.
    fresh : whether the simulator is compiled for this version; if not, the first simulation
        compiles it.
    log : the file in which the desk notes why it ended.
    """

    cartlab: str
    python: str
    system: str
    package: str
    needed: list[Package]
    extras: dict[str, list[Package]]
    programs: dict[str, str]
    compiled: str
    fresh: bool
    log: str

    @property
    def broken(self) -> list[Package]:
        """The needed packages that cannot be used."""
        return [one for one in self.needed if one.problem]


@app.command()
def doctor(as_json: AsJson = False) -> None:
    """Show what is installed, what is missing, and where things are."""
    health = examine()
    typer.echo(json.dumps(asdict(health), indent=1) if as_json else _text(health))
    if health.broken:
        raise typer.Exit(1)


def examine() -> Health:
    """Return the state of the installation."""
    from pipeline.desk.crash_log import find_log

    needed, extras = _packages()
    folder, fresh = "", False
    if not any(one.problem for one in needed if one.name in ("numba", "numpy")):
        from pipeline.plant.simulator import compiler

        folder, fresh = str(compiler.kept_in(compiler.ROOM) or ""), compiler.is_compiled()
    return Health(
        cartlab=__version__,
        python=platform.python_version(),
        system=platform.platform(),
        package=str(Path(__file__).parents[1]),
        needed=needed,
        extras=extras,
        programs={what: _first(names) for what, names in _PROGRAMS.items()},
        compiled=folder,
        fresh=fresh,
        log=str(find_log()),
    )


def _packages() -> tuple[list[Package], dict[str, list[Package]]]:
    """Return the packages that cartlab needs, and those of each extra."""
    from packaging.requirements import Requirement

    try:
        asked = [Requirement(text) for text in installed.requires("cartlab") or ()]
    except installed.PackageNotFoundError:  # the code is on the path, but pip did not install it
        return [_find_package("cartlab", "")], {}
    offered = installed.metadata("cartlab").get_all("Provides-Extra") or ()
    applies = {
        extra: [one for one in asked if one.marker is None or one.marker.evaluate({"extra": extra})]
        for extra in ("", *_EXTRAS)
        if extra in ("", *offered)
    }
    looked = {
        one.name: _find_package(one.name, str(one.specifier))
        for all_ in applies.values()
        for one in all_
    }
    needed = [looked[one.name] for one in applies.pop("")]
    return needed, {
        extra: [looked[one.name] for one in more if looked[one.name] not in needed]
        for extra, more in applies.items()
    }


def _find_package(name: str, wanted: str) -> Package:
    """Return a package, and its problem if it is missing, too old, or does not load."""
    from packaging.specifiers import SpecifierSet

    found = problem = ""
    try:
        found = installed.version(name)
    except installed.PackageNotFoundError:
        problem = "not installed"
    else:
        if not SpecifierSet(wanted).contains(found, prereleases=True):
            problem = f"version {found} is installed, {wanted} is needed"
        else:
            problem = _loading(_MODULES.get(name.lower(), name.lower().replace("-", "_")))
    return Package(name=name, wanted=wanted, found=found, problem=problem)


def _loading(module: str) -> str:
    """Return why a module does not load; "" if it does."""
    try:
        import_module(module)
    except Exception as error:  # a broken installation can raise any error
        return f"it does not load: {type(error).__name__}: {error}"
    return ""


def _first(programs: tuple[str, ...]) -> str:
    return next((path for name in programs if (path := shutil.which(name))), "")


def _text(health: Health) -> str:
    lines = [
        f"cartlab {health.cartlab}, Python {health.python}, {health.system}",
        f"  code: {health.package}",
        f"  command: {Path(sys.argv[0]).resolve()}",
    ]
    if health.broken:
        lines += ["needed packages with a problem; `pip install cartlab` again:"]
        lines += [f"  {one.name}: {one.problem}" for one in health.broken]
    else:
        lines += [f"needed packages: all {len(health.needed)} work"]
        lines += ["  " + ", ".join(f"{one.name} {one.found}" for one in health.needed)]
    lines += ["optional:"]
    for extra, packages in health.extras.items():
        lacking = [f"{one.name}: {one.problem}" for one in packages if one.problem]
        state = f"no ({'; '.join(lacking)}): pip install 'cartlab[{extra}]'" if lacking else "yes"
        lines += [f"  {extra}, {_EXTRAS[extra]}: {state}"]
    lines += [f"  {what}: {path or 'not found'}" for what, path in health.programs.items()]
    state = "fresh" if health.fresh else "not yet; the first simulation compiles it, in about 20 s"
    lines += [f"compiled simulator: {state}"]
    lines += [f"  folder: {health.compiled or 'none can be written, so each process compiles it'}"]
    lines += [f"log of the desk: {health.log}"]
    return "\n".join(lines)
