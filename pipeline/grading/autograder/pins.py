"""List the installed versions of all packages that cartlab needs, for a `requirements.txt`."""

import importlib.metadata as installed
from collections.abc import Set

from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from pipeline.errors import ConfigError

# Gradescope's machines run Linux; this computer may run another system.
_LINUX: dict[str, str | Set[str]] = {
    "os_name": "posix",
    "sys_platform": "linux",
    "platform_system": "Linux",
    "platform_machine": "x86_64",
}


def pin_requirements(package: str = "cartlab") -> list[str]:
    """Return `name==version` for each direct and indirect requirement of a package on Linux.

    A requirement that is not installed on this computer is left out. On Gradescope, pip then
    chooses its version.

    Raises
    ------
    ConfigError : `package` is not installed.
    """
    pinned: dict[str, str] = {}
    seen: set[tuple[str, str]] = set()
    waiting = [(package, "")]
    while waiting:
        name, extra = one = waiting.pop()
        if one in seen:
            continue
        seen.add(one)
        try:
            found = installed.distribution(name)
        except installed.PackageNotFoundError:
            if name == package:
                raise ConfigError(f"{package} is not installed here: run `pip install .`") from None
            continue
        if name != package:
            pinned[canonicalize_name(name)] = Version(found.version).public
        for needed in map(Requirement, found.requires or ()):
            if _applies(needed.marker, extra):
                waiting += [(needed.name, more) for more in ("", *needed.extras)]
    return [f"{name}=={version}" for name, version in sorted(pinned.items())]


def _applies(marker: Marker | None, extra: str) -> bool:
    return marker is None or marker.evaluate({**_LINUX, "extra": extra})
