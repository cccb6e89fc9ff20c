"""LeRobot: a dataset of version 3.0 for training policies."""

from device_agent.cli.export.errors import ExportError
from device_agent.cli.export.lerobot.dataset import DatasetWriter
from device_agent.cli.export.lerobot.images import colour_cameras
from device_agent.cli.export.lerobot.sampling import sample
from device_agent.cli.export.request import ExportFormat, ExportRequest


def create() -> ExportFormat:
    """The format."""
    return write


def write(request: ExportRequest) -> str:
    """Write a dataset; returns the number of its episodes and frames in words.

    Raises:
        ExportError: The recording cannot be read, or contains no frame.
    """
    cameras = colour_cameras(request)
    writer = DatasetWriter(request, cameras)
    for number, span_ns in enumerate(request.spans_ns()):
        parts = list(sample(request, span_ns, cameras))
        episode = request.episodes[number] if request.episodes else None
        for index, part in enumerate(parts):
            writer.add(part, episode, last=index == len(parts) - 1)
    if not writer.frames:
        raise ExportError(
            "no frame has a row and an image of each camera; check the times of the episodes, or leave cameras out "
            "with --camera"
        )
    writer.close()
    missing = [topic for topic in request.cameras if topic not in cameras]
    left_out = f"; without {', '.join(missing)}, which has no colour images" if missing else ""
    episodes = "1 episode" if writer.episodes == 1 else f"{writer.episodes} episodes"
    return f"{episodes} with {writer.frames} frames{left_out}"
