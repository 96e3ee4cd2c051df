"""Who may see what: everything for the person at this computer, else what a file says."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from pipeline.errors import ConfigError
from pipeline.submission.complaints import explain
from pipeline.submission.toml_file import parse_toml, read_text

Place = Path | str  # a folder, or the address of a database
Role = Literal["owner", "student", "ta", "instructor"]
_MOST_BYTES = 1_000_000


@dataclass(kw_only=True)
class User:
    """Somebody at the desk.

    Attributes
    ----------
    folders : the submissions that they see, addressed by their place in this list: of another's
        there is no address. An owner's list grows as they open folders.
    gradebooks : likewise, the outputs of gradings, or addresses of databases.
    """

    name: str
    role: Role
    folders: list[Path] = field(default_factory=list)
    gradebooks: list[Place] = field(default_factory=list)

    @property
    def owns(self) -> bool:
        """Whether they may open whatever this computer lets them."""
        return self.role == "owner"


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Proxy(_Model):
    """The reverse proxy in front, which knows who somebody is."""

    address: Annotated[str, Field(min_length=1)]  # of the proxy: nobody else may connect
    header: Annotated[str, Field(pattern=r"^[A-Za-z0-9-]+$")]  # in which it says the name
    site: Annotated[str, Field(pattern=r"^https?://[^/\s]+$")]  # that browsers ask for


class Listed(_Model):
    """One user of the file."""

    name: Annotated[str, Field(min_length=1)]
    role: Literal["student", "ta", "instructor"]
    folders: tuple[str, ...] = ()
    gradebooks: tuple[str, ...] = ()


class Users(_Model):
    """The file that `--users` names."""

    proxy: Proxy
    users: tuple[Listed, ...]


def read_users(path: Path) -> tuple[Proxy, dict[str, User]]:
    """Read who may see what; folders are relative to the file's own.

    Raises
    ------
    ConfigError : one line with the file, the key, what was expected, what was found.
    """
    text = read_text(path, where=str(path), limit=_MOST_BYTES, error=ConfigError)
    document = parse_toml(text, where=str(path), error=ConfigError)
    try:
        found = Users.model_validate(document)
    except ValidationError as error:
        tables = {"proxy": Proxy, "users": Listed}
        first = explain(
            error.errors()[0], document, tables=tables, top_level=tuple(Users.model_fields)
        )
        raise ConfigError(f"{path}: {first}") from None
    names = [user.name for user in found.users]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ConfigError(f"{path}: users: {twice!r} is there twice")
    root = path.resolve().parent
    return found.proxy, {
        user.name: User(
            name=user.name,
            role=user.role,
            folders=[root / folder for folder in user.folders],
            gradebooks=[one if "://" in one else root / one for one in user.gradebooks],
        )
        for user in found.users
    }


def place_name(place: Place) -> str:
    """Return what to call a place: of a database its name, never who opens it with which word."""
    if isinstance(place, str):
        parts = urlsplit(place)
        return parts.path.strip("/") or parts.hostname or parts.scheme
    return place.name or str(place)
