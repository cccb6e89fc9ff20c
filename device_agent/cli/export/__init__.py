"""``export``: convert the recording of a session to other formats."""

import argparse
import shutil
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from device_agent.cli.arguments import Commands
from device_agent.cli.export import episodes as marks
from device_agent.cli.export.errors import ExportError
from device_agent.cli.export.formats import EXTRA, FORMATS

if TYPE_CHECKING:
    from device_agent.cli.export.recording import Recording
    from device_agent.cli.export.request import ExportFormat, Progress

__all__ = ["ExportError", "add_commands"]

_MAX_FPS: Final = 200
_ALL_CAMERAS: Final = "all"
_NO_CAMERA: Final = "none"


def add_commands(commands: Commands, _home: Path) -> None:
    """Add ``export``."""
    parser = commands.add_parser(
        "export",
        help="export the recording of a session as LeRobot dataset, MCAP, CSV or Rerun file",
        description="Export the recording of a session from the server (--server, --device, --session, --api-key-file) "
        "or from files (--recording).",
    )
    source = parser.add_argument_group("recording on the server")
    source.add_argument("--server", metavar="URL", help="URL of the server")
    source.add_argument("--device", metavar="ID", help="id of the device, as its page in the console shows it")
    source.add_argument("--session", type=int, metavar="EPOCH", help="epoch of the session")
    source.add_argument("--api-key-file", type=Path, metavar="FILE", help="file with an API key of a viewer")
    source.add_argument("--ca", type=Path, metavar="FILE", help="certificate authority (PEM) of an https server")
    files = parser.add_argument_group("recording in files")
    files.add_argument(
        "--recording", type=Path, nargs="+", metavar="PATH", help="folder or MCAP files with the segments of a session"
    )
    files.add_argument("--episodes", type=Path, metavar="FILE", help="JSON file with a list of episodes")
    parser.add_argument("--format", required=True, choices=FORMATS.names(), help="format of the export")
    parser.add_argument(
        "--output", required=True, type=Path, metavar="PATH", help="new folder, for mcap and rerun a new file"
    )
    parser.add_argument(
        "--episode", type=int, metavar="N", help="export only this episode, from 0 (default: all, or the whole session)"
    )
    parser.add_argument("--fps", type=int, default=30, help="frames a second for lerobot (default: %(default)d)")
    parser.add_argument(
        "--camera",
        action="append",
        metavar="NAME",
        help=f"camera for lerobot and rerun; may be repeated; {_NO_CAMERA}: no camera (default: {_ALL_CAMERAS})",
    )
    parser.add_argument("--task", default="", help="task for lerobot of episodes without a label")
    parser.add_argument("--readable", action="store_true", help="export what is readable of damaged or missing files")
    parser.set_defaults(command=_export)


def _export(options: argparse.Namespace) -> int:
    try:
        # Imported here: other commands do not need the libraries of the export.
        from device_agent.cli.export.request import Progress  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise ExportError(
            f"the export needs {error.name}, which is not installed; run `pip install 'telescope-agent[{EXTRA}]'`"
        ) from error
    _check(options)
    create = FORMATS.load(options.format)
    with tempfile.TemporaryDirectory(prefix="telescope-export-") as folder:
        recording, episodes = _open(options, Path(folder), Progress())
        text = _write(options, cast("ExportFormat", create()), recording, episodes)
    print(f"exported {text} to {options.output}")
    return 0


def _check(options: argparse.Namespace) -> None:
    """Check the options before long work.

    Raises:
        ExportError: An option is wrong or missing.
    """
    remote = {
        "--server": options.server, "--device": options.device, "--session": options.session,
        "--api-key-file": options.api_key_file,
    }  # fmt: skip
    given = [name for name, value in remote.items() if value is not None]
    if options.recording is None and len(given) < len(remote):
        missing = ", ".join(name for name in remote if name not in given)
        raise ExportError(f"{missing} is missing; to export files of this machine use --recording instead")
    if options.recording is not None and given:
        raise ExportError(f"--recording cannot be combined with {', '.join(given)}")
    if options.recording is None and options.episodes is not None:
        raise ExportError("--episodes needs --recording; the server knows the episodes of its sessions")
    if not 1 <= options.fps <= _MAX_FPS:
        raise ExportError(f"--fps: {options.fps} is not between 1 and {_MAX_FPS}")
    if options.output.exists():
        raise ExportError(f"{options.output} exists; name a new path, or delete it first")


def _open(
    options: argparse.Namespace, folder: Path, progress: "Progress"
) -> tuple["Recording", tuple[marks.Episode, ...]]:
    from device_agent.cli.export import download  # noqa: PLC0415 (see _export)
    from device_agent.cli.export.recording import open_recording  # noqa: PLC0415 (see _export)

    report = _warn if options.readable else None
    if options.recording is not None:
        recording = open_recording(options.recording, report)
        episodes = () if options.episodes is None else marks.load(options.episodes)
    else:
        key = download.read_key(options.api_key_file)
        client = download.SessionClient(options.server, key, options.ca, progress)
        episodes = client.download(options.device, options.session, folder)
        recording = open_recording([folder], report)
    episodes = marks.check(episodes)
    if options.episode is not None:
        if not 0 <= options.episode < len(episodes):
            known = f"0 to {len(episodes) - 1}" if episodes else "none"
            raise ExportError(f"--episode: the session has no episode {options.episode}; it has {known}")
        episodes = (episodes[options.episode],)
    return recording, episodes


def _write(
    options: argparse.Namespace, export: "ExportFormat", recording: "Recording", episodes: tuple[marks.Episode, ...]
) -> str:
    """Write next to the output, and rename it at the end: an unfinished export must not look like a complete one."""
    from device_agent.cli.export.request import ExportRequest  # noqa: PLC0415 (see _export)

    output: Path = options.output
    output.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{output.name}-", dir=output.parent) as folder:
        unfinished = Path(folder) / output.name
        text = export(
            ExportRequest(
                recording=recording,
                episodes=episodes,
                output=unfinished,
                fps=options.fps,
                cameras=_cameras(options.camera, recording.cameras),
                task=options.task or f"operate {recording.info.device}",
            )
        )
        shutil.move(unfinished, output)
    return text


def _cameras(names: list[str] | None, topics: tuple[str, ...]) -> tuple[str, ...]:
    """Topics of the named cameras.

    Raises:
        ExportError: The recording has no camera of a name.
    """
    if names is None:
        return topics
    known = {topic.split("/", 2)[2]: topic for topic in topics}
    for name in names:
        if name not in known and name != _NO_CAMERA:
            raise ExportError(f"--camera: no camera '{name}'; the recording has: {', '.join(known) or _NO_CAMERA}")
    return tuple(known[name] for name in names if name != _NO_CAMERA)


def _warn(text: str) -> None:
    print(f"telescope agent: {text}", file=sys.stderr)
