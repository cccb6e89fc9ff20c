"""``cameras``: find ONVIF cameras in the network, and print the entry of one for ``agent.toml``."""

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from device_agent.cli.arguments import Commands
from device_agent.config.agent_config import DeviceEntry
from device_agent.config.errors import ConfigError
from device_agent.ports.sensor import SensorError
from device_agent.protocol import CameraStream
from device_agent.protocol.manifests.room import Watch
from device_agent.sensors.camera.options import Credentials, secret_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from device_agent.sensors.camera.onvif.client import Stream as OnvifStream
    from device_agent.sensors.camera.onvif.discovery import FoundCamera

_PREFERRED_WIDTH = 640
"""The agent publishes at most this width by default, so a larger stream costs processor time only [pixels]."""
_MAX_NAME = 40
_SOURCE = "colour"


def add_commands(commands: Commands, _home: Path) -> None:
    """Add ``cameras``."""
    parser = commands.add_parser("cameras", help="find ONVIF cameras, and print their entry for agent.toml")
    parser.add_argument(
        "--host", metavar="HOST[:PORT]", default="", help="one camera, also in another network; prints its entry"
    )
    parser.add_argument("--interface", metavar="ADDRESS", default="", help="IP address of the interface to search")
    parser.add_argument("--user", default="", help="user of the camera that --host names")
    parser.add_argument("--password-file", type=Path, metavar="FILE", help="file that contains the user's password")
    parser.add_argument("--ca", default="", metavar="FILE", help="certificate or authority (PEM) of an https camera")
    parser.add_argument("--wait-s", type=float, default=3.0, metavar="S", help="time for responses [s]")
    parser.set_defaults(command=_cameras)


def _cameras(options: argparse.Namespace) -> int:
    try:
        # Imported here: agents without cameras may have no defusedxml.
        from device_agent.sensors.camera.onvif import discovery  # noqa: PLC0415
    except ImportError as error:
        raise ConfigError(
            "finding cameras needs the package defusedxml; install it with `pip install telescope-agent[camera]`"
        ) from error
    credentials = _credentials(options)
    try:
        destination = _destination(options.host) if options.host else discovery.MULTICAST
        found = discovery.find(destination, interface=options.interface, wait_s=options.wait_s)
        if not found:
            raise ConfigError(_none_found(options))
        for camera in found:
            print(f"{camera.host}  {camera.name or 'no name'}")
        if not options.host:
            print("\nprint the entry of one: cameras --host ADDRESS --user NAME --password-file FILE")
            return 0
        _print_entry(found[0], credentials, options)
    except SensorError as error:
        raise ConfigError(str(error)) from error
    return 0


def _credentials(options: argparse.Namespace) -> Credentials | None:
    if bool(options.user) != bool(options.password_file):
        raise ConfigError("name both --user and --password-file, or neither")
    if not options.user:
        return None
    if not options.host:
        raise ConfigError("name the camera with --host: a password is not sent to every device that responds")
    try:
        return Credentials(options.user, secret_of(options.password_file.expanduser()))
    except SensorError as error:
        raise ConfigError(str(error)) from error


def _destination(text: str) -> tuple[str, int]:
    host, _, port = text.partition(":")
    if not host or (port and not (port.isdecimal() and 0 < int(port) < 2**16)):
        raise ConfigError(f"--host: '{text}' is not HOST or HOST:PORT")
    return host, int(port or 3702)


def _none_found(options: argparse.Namespace) -> str:
    advice = "enable ONVIF in the camera, and allow its responses from UDP port 3702 in the firewall"
    if options.host:
        return f"{options.host} has not responded within {options.wait_s:g} s; check the address, {advice}"
    return (
        f"no camera has responded within {options.wait_s:g} s; {advice}. A search reaches the own network only: name "
        "a camera of another one with --host, or another interface with --interface"
    )


def _print_entry(camera: "FoundCamera", credentials: Credentials | None, options: argparse.Namespace) -> None:
    from device_agent.sensors.camera.onvif.client import OnvifClient  # noqa: PLC0415 (as above)
    from device_agent.sensors.camera.onvif.messages import printable  # noqa: PLC0415 (as above)

    try:
        streams = OnvifClient(
            camera.service, credentials, ca=str(Path(options.ca).expanduser()) if options.ca else ""
        ).streams()
    except SensorError as error:
        hint = "" if credentials else "; most cameras need --user and --password-file"
        raise ConfigError(f"{error}{hint}") from error
    chosen = _choose(streams)
    for stream in streams:
        size = f"{stream.profile.width} x {stream.profile.height}" if stream.profile.width else "unknown size"
        print(f"stream  {stream.profile.name or printable(stream.profile.token)}: {size}", file=sys.stderr)
    login = (
        {"user": options.user, "password_file": str(options.password_file.expanduser().resolve())}
        if credentials
        else {}
    )
    name = re.sub(r"[^a-z0-9]+", "-", camera.name.lower()).strip("-")[:_MAX_NAME].strip("-") or "camera"
    entry = DeviceEntry(
        name=name,
        type="camera",
        driver="rtsp",
        label=camera.name or "Camera",
        cameras=(CameraStream(name=_SOURCE, rate_hz=10.0),),
        captures=("image",),
        watch=(Watch(source=_SOURCE, silent_s=10.0, stuck_s=60.0),),  # noise makes all images different
        options={"url": chosen.url, **login},
    )
    print("\n" + "\n".join(entry.lines()))


def _choose(streams: "Sequence[OnvifStream]") -> "OnvifStream":
    """The smallest stream that is wide enough, or else the largest."""
    wide = [stream for stream in streams if stream.profile.width >= _PREFERRED_WIDTH]
    if wide:
        return min(wide, key=lambda stream: stream.profile.width)
    return max(streams, key=lambda stream: stream.profile.width)
