"""Options of the camera drivers, addresses and credentials. No message contains a password or a path of an address."""

import os
import ssl
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar
from urllib.parse import SplitResult, unquote, urlsplit

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from device_agent.ports.sensor import SensorError

_MAX_SECRET = 1024

Rate = Annotated[float, Meta(gt=0, le=10)]
Seconds = Annotated[float, Meta(ge=1, le=60)]
Options = TypeVar("Options", bound=Struct)


class Timing(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of every camera driver.

    Attributes:
        rate_hz: Maximum rate of published frames [Hz].
        stale_s: Fault after this time without a new frame [s].
    """

    rate_hz: Rate = 5.0
    stale_s: Seconds = 5.0


class NetworkCamera(Timing, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of cameras with an address.

    Attributes:
        url: Address of the stream. It may contain user and password; a file keeps the password out of ``agent.toml``.
        user: User name; empty: that of ``url``, or none.
        password_file: Path of a file that contains only the password; relative to the agent's folder.
        password_env: Environment variable that contains the password.
    """

    url: str
    user: str = ""
    password_file: str = ""
    password_env: str = ""


Camera = TypeVar("Camera", bound=NetworkCamera)


class Credentials(NamedTuple):
    """User name and password of a camera."""

    user: str
    password: str


def parse(options: Mapping[str, Any], kind: type[Options], *, driver: str, device: str) -> Options:
    """Check the options of one device.

    Raises:
        SensorError: An option is unknown, missing or wrong. The message names it and does not contain its value.
    """
    for name in options:
        if name not in kind.__struct_fields__:
            valid = ", ".join(kind.__struct_fields__)
            raise SensorError(f"'{device}': driver '{driver}' has no option '{name}'; it has: {valid}")
    try:
        return msgspec.convert(options, kind, strict=False)
    except msgspec.ValidationError as error:
        raise SensorError(f"options of '{device}': {error}") from error


def with_files(camera: Camera, folder: Path) -> Camera:
    """The options with the paths of their files, which are relative to ``folder``.

    Raises:
        SensorError: A path begins with the home of a user who does not exist.
    """
    files = {name: getattr(camera, name) for name in ("password_file", "ca") if getattr(camera, name, "")}
    paths = {}
    for name, path in files.items():
        try:
            paths[name] = str(folder / Path(path).expanduser())
        except RuntimeError as error:
            raise SensorError(f"option '{name}': the user in the path does not exist; write the whole path") from error
    return replace(camera, **paths)


def split_address(url: str, schemes: tuple[str, ...]) -> SplitResult:
    """The parts of an address.

    Raises:
        SensorError: It is not an address with one of the schemes. The message does not contain it.
    """
    try:
        parts = urlsplit(url)
        valid = parts.scheme in schemes and bool(parts.hostname) and parts.port != 0
    except ValueError:
        valid = False
    if not valid or " " in url or not url.isprintable():
        examples = " or ".join(f"{scheme}://host/path" for scheme in schemes)
        raise SensorError(f"option 'url' must be an address such as {examples}")
    return parts


def shown(parts: SplitResult) -> str:
    """Scheme, host and port for messages. User, path and query may contain passwords."""
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}"


def credentials(camera: NetworkCamera) -> Credentials | None:
    """User and password, read now from their places; ``None`` without a user.

    Raises:
        SensorError: The file or environment variable of the password is missing or empty, or there is no user.
    """
    parts = urlsplit(camera.url)
    user = camera.user or unquote(parts.username or "")
    password = unquote(parts.password or "")
    if camera.password_file:
        password = secret_of(Path(camera.password_file))
    elif camera.password_env:
        password = os.environ.get(camera.password_env, "")
        if not password:
            raise SensorError(f"the environment variable {camera.password_env}, option 'password_env', is not set")
    if password and not user:
        raise SensorError("the password needs the option 'user'")
    return Credentials(user, password) if user else None


def secret_of(path: Path) -> str:
    """The first line of a file that contains a password.

    Raises:
        SensorError: The file cannot be read, or is empty.
    """
    try:
        with path.open(encoding="utf-8") as file:
            secret = file.readline(_MAX_SECRET).rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise SensorError(f"password file {path}: {reason}") from error
    if not secret:
        raise SensorError(f"password file {path} is empty")
    return secret


def tls_context(ca: str) -> ssl.SSLContext:
    """Verifies servers with this authority, or with those of the operating system if ``ca`` is empty.

    Raises:
        SensorError: The file is missing or no certificate.
    """
    try:
        return ssl.create_default_context(cafile=ca or None)
    except OSError as error:
        raise SensorError(f"option 'ca': {ca} cannot be read as a certificate") from error
