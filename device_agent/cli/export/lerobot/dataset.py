"""Files of a LeRobot dataset, version 3.0.

The layout is that of https://huggingface.co/docs/lerobot/lerobot-dataset-v3: rows in Parquet, one MP4 file for each
camera and episode, and metadata in ``meta``.
"""

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from device_agent.cli.export.episodes import SUCCESS, Episode
from device_agent.cli.export.lerobot import statistics
from device_agent.cli.export.lerobot.images import CODEC, Decoder, VideoWriter, images
from device_agent.cli.export.lerobot.sampling import Samples
from device_agent.cli.export.lerobot.statistics import ImageStatistics
from device_agent.cli.export.request import ExportRequest
from device_agent.runtime.recording import format as recording_format

VERSION: Final = "v3.0"
STATE, ACTION, IMAGES = "observation.state", "action", "observation.images"
_CHUNK: Final = 1000
"""Maximum number of files in one folder."""
_FILE: Final = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_FIRST: Final = _FILE.format(chunk_index=0, file_index=0)
_STATISTICS_EVERY: Final = 10
"""Statistics of images use one image of this number."""
_NUMBERS: Final = {
    "timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64",
    "next.done": "bool", "next.success": "bool",
}  # fmt: skip
"""Features with one number."""


def camera_key(topic: str) -> str:
    """Name of the feature with the images of a camera: ``/frames/front`` → ``observation.images.front``."""
    return f"{IMAGES}.{topic.removeprefix(recording_format.FRAMES).replace('/', '.')}"


class DatasetWriter:
    """Writes one dataset; episodes are appended one after the other.

    Args:
        request: The export.
        cameras: Topics of the exported cameras.
    """

    def __init__(self, request: ExportRequest, cameras: Sequence[str]) -> None:
        self._request, self._root = request, request.output
        self._joints = [f"{joint}.pos" for joint in request.recording.info.joints]
        self._decoders = {topic: Decoder(topic) for topic in cameras}
        self._image_statistics = {topic: ImageStatistics() for topic in cameras}
        self._pixel_formats: dict[str, str] = {}
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._columns: list[dict[str, Any]] = []
        self._parts: list[dict[str, Any]] = []
        self.frames = 0
        path = self._root / "data" / f"{_FIRST}.parquet"
        path.parent.mkdir(parents=True)
        self._rows = pq.ParquetWriter(path, self._schema())

    @property
    def episodes(self) -> int:
        """Number of written episodes."""
        return len(self._episodes)

    def add(self, samples: Samples, episode: Episode | None, *, last: bool) -> None:
        """Append one episode of the dataset.

        Args:
            samples: Its frames.
            episode: The marked episode that contains it; ``None`` for a session without marks.
            last: Whether it contains the end of the marked episode, where its goal may be reached.

        Raises:
            ExportError: An image cannot be decoded, or the recording cannot be read.
        """
        count, number = len(samples.time_ns), len(self._episodes)
        succeeded = episode is not None and episode.outcome == SUCCESS
        task = (episode.label if episode is not None else None) or self._request.task
        ends = np.arange(count) == count - 1
        columns: dict[str, Any] = {
            STATE: samples.state,
            ACTION: samples.action,
            "timestamp": (np.arange(count) / self._request.fps).astype(np.float32),
            "frame_index": np.arange(count),
            "episode_index": np.full(count, number),
            "index": np.arange(self.frames, self.frames + count),
            "task_index": np.full(count, self._tasks.setdefault(task, len(self._tasks))),
            "next.done": ends,
            "next.success": ends & (succeeded and last),
        }
        self._rows.write_table(self._table(columns), row_group_size=count)
        stats = {name: statistics.of_columns(values.reshape(count, -1)) for name, values in columns.items()}
        row: dict[str, Any] = {
            "episode_index": number,
            "tasks": [task],
            "length": count,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + count,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
            "success": succeeded and last,
        }
        for topic in self._decoders:
            key = camera_key(topic)
            of_images = self._video(topic, number, samples)
            self._image_statistics[topic].merge(of_images)
            stats[key] = of_images.result()
            row |= {
                f"videos/{key}/chunk_index": number // _CHUNK,
                f"videos/{key}/file_index": number % _CHUNK,
                f"videos/{key}/from_timestamp": 0.0,
                f"videos/{key}/to_timestamp": count / self._request.fps,
            }
        row |= {f"stats/{name}/{kind}": value for name, of in stats.items() for kind, value in of.items()}
        self._episodes.append(row)
        self._columns.append(columns)
        self._parts.append(self._origin(samples, episode))
        self.frames += count

    def close(self) -> None:
        """Write the metadata."""
        self._rows.close()
        meta = self._root / "meta"
        episodes = meta / "episodes" / f"{_FIRST}.parquet"
        episodes.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self._episodes), episodes)
        pq.write_table(_tasks(list(self._tasks)), meta / "tasks.parquet")
        totals = {
            name: np.concatenate([columns[name].reshape(len(columns[name]), -1) for columns in self._columns])
            for name in self._columns[0]
        }
        stats = {name: statistics.of_columns(values) for name, values in totals.items()}
        stats |= {camera_key(topic): images.result() for topic, images in self._image_statistics.items()}
        _write_json(meta / "stats.json", stats)
        _write_json(meta / "info.json", self._info())
        _write_json(meta / "telescope.json", self._source())

    def _schema(self) -> pa.Schema:
        vector = pa.list_(pa.float32(), len(self._joints)) if len(self._joints) > 1 else pa.float32()
        numbers = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}
        return pa.schema({STATE: vector, ACTION: vector} | {name: numbers[kind] for name, kind in _NUMBERS.items()})

    def _table(self, columns: dict[str, Any]) -> pa.Table:
        schema, arrays = self._schema(), []
        for name in schema.names:
            kind, values = schema.field(name).type, columns[name]
            if pa.types.is_fixed_size_list(kind):
                arrays.append(pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), type=kind))
            else:
                arrays.append(pa.array(values.reshape(-1), kind))
        return pa.Table.from_arrays(arrays, schema=schema)

    def _video(self, topic: str, number: int, samples: Samples) -> ImageStatistics:
        """Write the video of one camera and episode; returns the statistics of its images."""
        place = _FILE.format(chunk_index=number // _CHUNK, file_index=number % _CHUNK)
        path = self._root / "videos" / camera_key(topic) / f"{place}.mp4"
        of_images = ImageStatistics()
        data = images(self._request, topic, samples.images[topic].tolist())
        with ExitStack() as stack:
            writer: VideoWriter | None = None
            for index, message in enumerate(self._request.progress.count(data, f"frames of {topic}")):
                pixels = self._decoders[topic].decode(message)
                if writer is None:
                    writer = VideoWriter(path, self._request.fps, (pixels.shape[1], pixels.shape[0]))
                    stack.callback(writer.close)
                    self._pixel_formats[topic] = writer.pixel_format
                writer.add(pixels)
                if index % _STATISTICS_EVERY == 0:
                    of_images.add(pixels)
        return of_images

    def _info(self) -> dict[str, Any]:
        vector = {"dtype": "float32", "shape": [len(self._joints)], "names": self._joints}
        features: dict[str, Any] = {STATE: vector, ACTION: vector}
        for topic, decoder in self._decoders.items():
            width, height = decoder.size or (0, 0)
            features[camera_key(topic)] = {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
                "info": {
                    "video.height": height,
                    "video.width": width,
                    "video.codec": CODEC,
                    "video.pix_fmt": self._pixel_formats[topic],
                    "video.fps": self._request.fps,
                    "video.channels": 3,
                    "has_audio": False,
                    "is_depth_map": False,
                },
            }
        features |= {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _NUMBERS.items()}
        return {
            "codebase_version": VERSION,
            "robot_type": self._request.recording.info.robot_type,
            "total_episodes": len(self._episodes),
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._request.fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": f"data/{_FILE}.parquet",
            "video_path": f"videos/{{video_key}}/{_FILE}.mp4" if self._decoders else None,
            "features": features,
        }

    def _source(self) -> dict[str, Any]:
        info = self._request.recording.info
        return {
            "device": info.device,
            "robot_type_version": info.robot_type_version,
            "epoch": info.epoch,
            "simulated": info.simulated,
            "software": info.software,
            "units": {STATE: "rad; m for prismatic joints", ACTION: "rad; m for prismatic joints", "timestamp": "s"},
            "episodes": self._parts,
        }

    def _origin(self, samples: Samples, episode: Episode | None) -> dict[str, Any]:
        at = self._request.recording.session_s
        return {
            "start_s": at(int(samples.time_ns[0])),
            "end_s": at(int(samples.time_ns[-1])),
            "first_sequence": int(samples.row[0]),
            "last_sequence": int(samples.row[-1]),
            "outcome": episode and episode.outcome,
            "label": episode and episode.label,
            "note": episode and episode.note,
        }


def _tasks(tasks: list[str]) -> pa.Table:
    """The table of tasks. Its metadata make the text of a task the index, as LeRobot expects of a data frame."""
    described = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
        {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object"},
    ]
    metadata = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [column | {"metadata": None} for column in described],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(metadata)})


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False) + "\n", encoding="utf-8")
