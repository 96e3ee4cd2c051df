"""The ports to which a bench may be connected: real ones, virtual ones, and the last one used."""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pipeline.bench.serial_line import port_names
from pipeline.desk.crash_log import find_log
from pipeline.desk.page_request import PageRequest
from pipeline.errors import ConfigError
from pipeline.output import write_file
from pipeline.simulated.links import running_benches

_KEPT = 200  # folders whose port is remembered


@dataclass(frozen=True, kw_only=True)
class Port:
    """A port that the user can choose.

    Attributes
    ----------
    name : the device at the port, as far as the system knows it.
    """

    address: str
    name: str


def list_ports(ask: PageRequest) -> list[Port]:
    """Return the ports at which a person may record, the most likely first.

    The last port used in this folder comes first if it still exists. Ports with a device follow,
    and then the virtual benches on this computer. On a lab server, only the ports in the list of
    users are returned.
    """
    used = _read_memory().get(str(ask.folder()), "")
    if ask.user.owns:
        plugged = [Port(address=name.partition(" (")[0], name=name) for name in port_names()]
        virtual = [
            Port(address=one.address, name=f"virtual bench {one.name} ({one.address})")
            for one in running_benches()
        ]
        # A port about which the system knows nothing seldom has a bench, so it comes last.
        unknown = [port for port in plugged if port.name == port.address]
        found = [port for port in plugged if port not in unknown] + virtual + unknown
    else:
        found = [Port(address=at, name=at) for at in ask.user.ports]
    if used and ask.user.owns and used not in [port.address for port in found]:
        found.append(Port(address=used, name=f"{used} (used last, not found now)"))
        return found
    return sorted(found, key=lambda port: port.address != used)


def read_port(ask: PageRequest) -> str:
    """Return the port that was typed, or else the one that was chosen; remember it for this folder.

    Raises
    ------
    ConfigError : the form has no port, or one that is not listed for this person.
    """
    port = ask.text("other") or ask.text("port")
    if not port:
        raise ConfigError("choose the port of the bench, or type one such as COM3 or /dev/ttyACM0")
    if not ask.user.owns and port not in ask.user.ports:
        raise ConfigError(
            f"{port}: is not one of your ports, which are {', '.join(ask.user.ports)}"
        )
    _remember(ask.folder(), port)
    return port


def _remember(folder: Path, port: str) -> None:
    ports = {at: used for at, used in _read_memory().items() if at != str(folder)}
    kept = dict(list(ports.items())[1 - _KEPT :]) | {str(folder): port}
    with suppress(OSError):  # the home folder is not writable: nothing is remembered
        write_file(_find_memory(), json.dumps(kept, indent=1), private=True)


def _read_memory() -> dict[str, str]:
    """Return the last port used in each folder; the folder used last comes last."""
    try:
        read = json.loads(_find_memory().read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    pairs: Sequence[tuple[object, object]] = list(read.items()) if isinstance(read, dict) else []
    return {str(folder): str(port) for folder, port in pairs}


def _find_memory() -> Path:
    return find_log().with_suffix(".ports.json")
