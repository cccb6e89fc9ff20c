"""The agent's own folder: identity, configuration, pairing, journal. Survives restarts and updates.

```
identity.pem     the private key, mode 0600; never leaves the machine
agent.toml       server, transport and devices; written by ``enroll``, edited by people
server-ca.pem    the authority that may speak for the server, where ``enroll --ca`` pinned one
pairing.json     space, account and pinned keys, once claimed; written before a new key is obeyed
journal.db       what must not be forgotten
outbox.db        what could not be sent yet
running.lock     held by the agent that runs: two on one robot would fight
```
"""

import contextlib
import json
import logging
import os
import sqlite3
import ssl
import stat
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from msgspec import Meta, Struct
from msgspec.structs import replace

from device_agent.protocol import Id, Label
from device_agent.protocol.errors import ProtocolError
from device_agent.protocol.fields import Milliseconds
from device_agent.protocol.security import signing
from device_agent.protocol.security.key_rotation import Serial
from device_agent.runtime.authority.interlocks import Interlock

SERVER_CA = "server-ca.pem"
_log = logging.getLogger(__name__)


class ConfigError(Exception):
    """The folder is not usable; the text says which file and what to do."""


class DeviceEntry(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[devices]]`` of ``agent.toml``. ``driver`` is empty for the one that the robot type names.

    ``room``: it stands in that room, whose manifest has a robot or a device of the same name and type.
    """

    name: Id
    type: Id
    room: str = ""
    driver: str = ""
    label: Label = ""
    options: dict[str, Any] = {}
    interlocks: Annotated[tuple[Interlock, ...], Meta(max_length=32)] = ()


class RoomStream(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One ``[[room]]`` of ``agent.toml``: a stream that movements may ask for, of a device of the same space.

    ``device`` is its id as the console shows it, or the name of one of this agent's own devices.
    """

    device: Id
    stream: Id


class HttpPolling(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[http]`` of ``agent.toml``: how the agent asks for its commands where its transport is ``http``.

    ``long``: the cloud answers when there is one. ``plain``: it answers at once, and is asked every ``poll_ms`` [ms].
    """

    poll: Literal["long", "plain"] = "long"
    poll_ms: Annotated[int, Meta(ge=50, le=10_000)] = 1000


class Buffer(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[buffer]`` of ``agent.toml``: what is kept on disk while the link is down.

    Attributes:
        max_mb: Most that is kept [MB]; the oldest goes first.
        max_age_h: Older measurements are dropped [h]; the cloud takes in none that are older than a day.
        measurements_hz: Of each stream so many in a second are kept, at most [Hz].
        settle_s: Over MQTT nothing of it is sent so soon after the link has come [s]: the cloud's worker, which has
            lost the same broker, may still be on its way back.
    """

    max_mb: Annotated[float, Meta(ge=1, le=10_000)] = 64
    max_age_h: Annotated[float, Meta(gt=0, le=720)] = 24
    measurements_hz: Annotated[float, Meta(ge=0.01, le=20)] = 1
    settle_s: Annotated[float, Meta(ge=0, le=600)] = 8


class Configuration(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``agent.toml``. ``transport`` is one of ``device_agent.transports.factory.names()``.

    ``ca``: a file beside it, the authority that alone may speak for the server. ``allow_unconfined_scripts``: movement scripts
    run also where this machine cannot lock them in. Set by hand, on the machine.
    """

    server: str
    name: Label
    devices: tuple[DeviceEntry, ...]
    ca: str = ""
    transport: str = "mqtt"
    http: HttpPolling = HttpPolling()
    allow_unconfined_scripts: bool = False
    buffer: Buffer = Buffer()
    room: Annotated[tuple[RoomStream, ...], Meta(max_length=64)] = ()

    def keeping(self, before: "Configuration") -> "Configuration":
        """This, with what ``enroll`` does not ask for as it was before: buffer, room, each device's interlocks."""
        rules = {device.name: device.interlocks for device in before.devices}
        devices = tuple(replace(device, interlocks=rules.get(device.name, ())) for device in self.devices)
        return replace(
            self,
            devices=devices,
            room=before.room,
            buffer=before.buffer,
            allow_unconfined_scripts=before.allow_unconfined_scripts,
        )

    @property
    def sources(self) -> tuple[tuple[str, str], ...]:
        """Device and stream of everything of the room that this agent listens to."""
        named = [(stream.device, stream.stream) for stream in self.room]
        named += [(rule.device, rule.stream) for device in self.devices for rule in device.interlocks]
        return tuple(dict.fromkeys(named))


class Pairing(Struct, frozen=True, kw_only=True):
    """``pairing.json``: what the agent learned when it was claimed. ``keys`` are pinned: key id → public key.

    ``owner`` is the account's id: scripts of any other account are a stranger's. ``serial`` is the newest key's, and
    only rises; ``until_ms`` says when each of the others ends, on the cloud's clock.
    """

    agent: Id
    space: Id
    account: str
    keys: dict[str, str]
    owner: str = ""
    serial: Serial = 1
    until_ms: dict[str, Milliseconds] = {}

    def public_keys(self) -> dict[str, Ed25519PublicKey]:
        """The pinned keys, ready to verify with."""
        return {name: signing.public_key(text) for name, text in self.keys.items()}


class Home:
    """Reads and writes the folder. The constructor touches nothing.

    Args:
        folder: Where; made when something is first written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.journal = folder / "journal.db"
        self.outbox = folder / "outbox.db"
        self.faults = folder / "faults"

    def identity(self, *, create: bool = False) -> Ed25519PrivateKey:
        """The agent's private key.

        Raises:
            HomeError: Not there (and not to be made), or unreadable.
        """
        path = self.folder / "identity.pem"
        if create and not path.exists():
            key = signing.generate()
            pem = key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
            write(path, pem)
            return key
        try:
            _close_to_others(path)
            key = serialization.load_pem_private_key(path.read_bytes(), None)  # type: ignore[assignment]
        except FileNotFoundError as error:
            raise ConfigError(f"{self.folder} holds no agent; run `python -m device_agent enroll` first") from error
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path} cannot be read as a private key: {error}") from error
        if not isinstance(key, Ed25519PrivateKey):
            raise ConfigError(f"{path} is not an Ed25519 key")
        return key

    def configuration(self) -> Configuration:
        """``agent.toml``.

        Raises:
            HomeError: Missing or wrong; the text names the field.
        """
        path = self.folder / "agent.toml"
        try:
            raw = tomllib.loads(path.read_text(encoding="utf-8"))
            found = msgspec.convert(raw, Configuration)
        except FileNotFoundError as error:
            raise ConfigError(f"{path} is missing; run `python -m device_agent enroll` first") from error
        except (OSError, tomllib.TOMLDecodeError, msgspec.ValidationError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: {error}") from error
        names = [device.name for device in found.devices]
        if not names or len(set(names)) != len(names):
            raise ConfigError(f"{path}: needs at least one device, each with a name of its own")
        for source, _ in found.sources:
            if source not in names and "-" not in source:
                raise ConfigError(
                    f"{path}: '{source}' is no device of this agent ({', '.join(names)}); "
                    "name one of another agent by its id, as the console shows it"
                )
        for device in found.devices:
            rules = [rule.name for rule in device.interlocks]
            if len(set(rules)) != len(rules):
                raise ConfigError(
                    f"{path}: two interlocks of '{device.name}' have the same device, stream and condition"
                )
        return found

    def save_configuration(self, configuration: Configuration) -> None:
        """Write ``agent.toml``."""
        lines = [f"{key} = {_toml(getattr(configuration, key))}" for key in ("server", "name", "transport")]
        if configuration.ca:
            lines.insert(1, f"ca = {_toml(configuration.ca)}")
        if configuration.allow_unconfined_scripts:
            lines.append("allow_unconfined_scripts = true")
        if configuration.transport == "http" or configuration.http != HttpPolling():
            lines += ["", "[http]"]
            lines += [f"{key} = {_toml(getattr(configuration.http, key))}" for key in ("poll", "poll_ms")]
        if configuration.buffer != Buffer():
            lines += ["", "[buffer]", *_table(configuration.buffer)]
        for stream in configuration.room:
            lines += ["", "[[room]]", *_table(stream)]
        for device in configuration.devices:
            lines += ["", "[[devices]]"]
            lines += [f"{key} = {_toml(getattr(device, key))}" for key in ("name", "type", "driver", "label")]
            if device.room:
                lines.append(f"room = {_toml(device.room)}")
            if device.options:
                lines.append("[devices.options]")
                lines += [f"{_toml(key)} = {_toml(value)}" for key, value in device.options.items()]
            for rule in device.interlocks:
                lines += ["", "[[devices.interlocks]]", *_table(rule)]
        write(self.folder / "agent.toml", ("\n".join(lines) + "\n").encode())

    def authority(self, configuration: Configuration) -> Path | None:
        """The pinned authority's certificate.

        Raises:
            HomeError: It is named, and not there.
        """
        if not configuration.ca:
            return None
        path = self.folder / configuration.ca
        if not path.is_file():
            raise ConfigError(f"{path} is not there, which agent.toml names as `ca`; give it again with `enroll --ca`")
        return path

    def pin_authority(self, given: Path) -> str:
        """Keep a copy of an authority's certificate; its name for ``agent.toml``.

        Raises:
            HomeError: It cannot be read, or is none.
        """
        try:
            content = given.read_bytes()
            ssl.create_default_context(cadata=content.decode())
        except (OSError, ValueError) as error:
            raise ConfigError(f"--ca: {given} cannot be read as a certificate: {error}") from error
        write(self.folder / SERVER_CA, content)
        return SERVER_CA

    def pairing(self) -> Pairing | None:
        """What was learned when the agent was claimed, or ``None`` before.

        Raises:
            HomeError: Damaged.
        """
        path = self.folder / "pairing.json"
        try:
            found = msgspec.json.decode(path.read_bytes(), type=Pairing)
            found.public_keys()
        except FileNotFoundError:
            return None
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError, ProtocolError) as error:
            raise ConfigError(f"{path}: {error}; delete it and enroll again") from error
        return found

    def save_pairing(self, pairing: Pairing | None) -> None:
        """Write ``pairing.json``, or remove it."""
        path = self.folder / "pairing.json"
        if pairing is None:
            path.unlink(missing_ok=True)
        else:
            write(path, msgspec.json.encode(pairing))

    @contextlib.contextmanager
    def hold(self) -> Iterator[None]:
        """Be the only one who runs this agent, until the end of the ``with`` or of the process.

        A lock of SQLite's: the same on every system, and gone with its holder however that ends.

        Raises:
            HomeError: Another process runs it, or there is no agent.
        """
        if not self.folder.is_dir():
            raise ConfigError(f"{self.folder} holds no agent; run `python -m device_agent enroll` first")
        path = self.folder / "running.lock"
        with contextlib.ExitStack() as holding:
            try:
                lock = holding.enter_context(contextlib.closing(sqlite3.connect(path, timeout=0, isolation_level=None)))
                lock.execute("BEGIN EXCLUSIVE")
            except sqlite3.Error as error:
                if "locked" in str(error):
                    raise ConfigError(
                        f"another process runs the agent of {self.folder} already; end it first"
                    ) from error
                raise ConfigError(f"{path} cannot be written: {error}") from error
            yield


def write(path: Path, content: bytes) -> None:
    """Write a file of the agent's folder whole or not at all, readable by the owner alone.

    Raises:
        HomeError: It cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        handle, temporary = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}") from error


def _close_to_others(path: Path) -> None:
    """Keep others of this machine from a key. Windows has no such rights: there the folder's own hold."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if os.name != "nt" and mode & (stat.S_IRWXG | stat.S_IRWXO):
        path.chmod(stat.S_IRUSR | stat.S_IWUSR)
        _log.warning(
            "%s was open to others of this machine (mode %03o) and is no longer; if one of them may have read it, "
            "delete it and enroll again",
            path,
            mode,
        )


def _table(entry: Struct) -> list[str]:
    """The fields of an entry that were given."""
    return [f"{key} = {_toml(value)}" for key, value in msgspec.to_builtins(entry).items() if value is not None]


def _toml(value: Any) -> str:
    """A value as TOML writes it: as JSON does, but for tables, and for characters that JSON escapes in two halves."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_toml(key)} = {_toml(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(each) for each in value) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
