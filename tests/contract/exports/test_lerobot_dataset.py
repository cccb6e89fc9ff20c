"""LeRobot's own loader reads an export, and returns what the recording contains."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
import pytest

from device_agent import __main__ as program
from device_agent.cli.export.lerobot import dataset
from device_agent.cli.export.recording import Recording
from tests.contract.exports import loader
from tests.contract.exports.loader import Loaded
from tests.harness.agent.recordings.synthetic import Session, pixels, write_session

FPS: Final = 30
IMAGE_AGE_NS: Final = 1_000_000_000
TOLERANCE: Final = 6.0
"""Mean difference of a decoded image, as JPEG and video change it [levels of 255]; neighbours differ by 37."""
FRONT, CEILING = "/frames/front", "/frames/lab/ceiling"
SESSION: Final = Session(
    periods=400,
    # Ten lost periods are a gap. One lost period is none: two periods between rows.
    missing={*range(80, 90), 120},
    # The camera at the front loses its connection for two seconds.
    cameras={FRONT: [*range(0, 200, 3), *range(300, 400, 3)], CEILING: range(1, 400, 7)},
    every=150,
)
ONE_JOINT: Final = Session(periods=50, joints=("gripper",))
EPISODES: Final = (
    {"start_s": 0.5, "end_s": 3.0, "outcome": "success", "label": "pick the cube", "note": "slow"},
    {"start_s": 3.2, "end_s": 7.9, "outcome": "failure", "label": "place the cube", "note": ""},
)

pytestmark = [
    pytest.mark.long,  # `make test-long` installs the loader: 1.6 GB
    pytest.mark.timeout(1500),
]


@dataclass(frozen=True)
class Frame:
    """What a frame of the dataset must contain: numbers of the row and of the images, and its place."""

    period: int
    front: int
    ceiling: int
    episode: int
    index: int
    marked: int


def expected_frames() -> Iterator[Frame]:
    """The frames, found one by one."""
    number = 0
    for marked, episode in enumerate(EPISODES):
        start_s, end_s = float(str(episode["start_s"])), float(str(episode["end_s"]))
        recorded = [
            period
            for period in range(SESSION.periods)
            if period not in SESSION.missing and start_s * 50 <= period <= end_s * 50
        ]
        for part in _without_gaps(recorded):
            start_ns, end_ns = SESSION.time_ns(part[0]), SESSION.time_ns(part[-1])
            times_ns = (start_ns + frame * 10**9 // FPS for frame in range(10_000))
            frames = [_frame(part, time_ns) for time_ns in times_ns if time_ns <= end_ns]
            for complete, group in groupby(frames, key=lambda frame: frame is not None):
                if complete:
                    for index, frame in enumerate(group):
                        assert frame is not None
                        yield Frame(*frame, number, index, marked)
                    number += 1


def _without_gaps(recorded: list[int]) -> Iterator[list[int]]:
    part = recorded[:1]
    for period in recorded[1:]:
        if period - part[-1] > 2:
            yield part
            part = []
        part.append(period)
    yield part


def _frame(part: list[int], time_ns: int) -> tuple[int, int, int] | None:
    row = max(period for period in part if SESSION.time_ns(period) <= time_ns)
    chosen = []
    for topic in (FRONT, CEILING):
        taken = [number for number, at in enumerate(SESSION.cameras[topic]) if SESSION.time_ns(at) <= time_ns]
        if not taken or time_ns - SESSION.time_ns(SESSION.cameras[topic][taken[-1]]) > IMAGE_AGE_NS:
            return None
        chosen.append(taken[-1])
    return row, chosen[0], chosen[1]


def differences(loaded: Loaded) -> list[str]:
    """Every difference between the loaded dataset and the recording."""
    expected, arrays = list(expected_frames()), loaded.arrays
    if len(arrays["index"]) != len(expected):
        return [f"{len(arrays['index'])} frames instead of {len(expected)}"]
    rows = [SESSION.row(frame.period) for frame in expected]
    ends = [number + 1 == len(expected) or expected[number + 1].index == 0 for number in range(len(expected))]
    wanted = {
        "observation.state": np.array([row.position_rad for row in rows], dtype=np.float32),
        "action": np.array([row.applied_rad for row in rows], dtype=np.float32),
        "episode_index": np.array([frame.episode for frame in expected]),
        "frame_index": np.array([frame.index for frame in expected]),
        "index": np.arange(len(expected)),
        "timestamp": np.array([frame.index / FPS for frame in expected], dtype=np.float32),
        "next.done": np.array(ends),
    }
    found = [name for name, values in wanted.items() if not np.array_equal(arrays[name], values)]
    for key, numbers in (
        ("observation.images.front", [frame.front for frame in expected]),
        ("observation.images.lab.ceiling", [frame.ceiling for frame in expected]),
    ):
        images = np.round(arrays[key].transpose(0, 2, 3, 1) * 255).astype(int)
        difference = [
            np.abs(image - pixels(number).astype(int)).mean() for image, number in zip(images, numbers, strict=True)
        ]
        if max(difference) > TOLERANCE:
            found.append(f"{key}: {max(difference):.1f}")
    return found


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Loaded]:
    """Exports of one recording, one right and the others with a planted defect, read by one start of the loader."""
    folder = tmp_path_factory.mktemp("exports")
    write_session(folder / "recording", SESSION)
    (folder / "episodes.json").write_text(json.dumps(EPISODES), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        for name, plant in {"right": lambda _: None, **DEFECTS}.items():
            with patch.context() as planted:
                plant(planted)
                arguments = ["--recording", folder / "recording", "--episodes", folder / "episodes.json"]
                arguments += ["--format", "lerobot", "--output", folder / name]
                assert program.main(["export", *map(str, arguments)]) == 0
    write_session(folder / "one-joint-recording", ONE_JOINT)
    arguments = ["--recording", folder / "one-joint-recording", "--format", "lerobot", "--output", folder / "one-joint"]
    assert program.main(["export", *map(str, arguments)]) == 0
    return loader.load([folder / name for name in ("right", *DEFECTS, "one-joint")], folder / "loaded")


def _change_samples(patch: pytest.MonkeyPatch, change: Callable[[Any], Any]) -> None:
    add = dataset.DatasetWriter.add
    patch.setattr(
        dataset.DatasetWriter, "add", lambda self, samples, *args, **names: add(self, change(samples), *args, **names)
    )


def _state_of_next_row(patch: pytest.MonkeyPatch) -> None:
    _change_samples(patch, lambda samples: replace(samples, state=np.roll(samples.state, -1, axis=0)))


def _previous_image(patch: pytest.MonkeyPatch) -> None:
    def change(samples: Any) -> Any:
        front = samples.images[FRONT]
        return replace(samples, images={**samples.images, FRONT: np.concatenate((front[:1], front[:-1]))})

    _change_samples(patch, change)


def _commanded_instead_of_applied(patch: pytest.MonkeyPatch) -> None:
    decode = Recording._decode

    def planted(self: Recording, entry: Any) -> Any:
        row = decode(self, entry)
        return msgspec.structs.replace(row, applied_rad=row.commanded_rad)

    patch.setattr(Recording, "_decode", planted)


def _joined_gap(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Recording, "_is_gap", lambda *_: False)


DEFECTS: Final[dict[str, Callable[[pytest.MonkeyPatch], None]]] = {
    "next-row": _state_of_next_row,
    "previous-image": _previous_image,
    "commanded": _commanded_instead_of_applied,
    "joined-gap": _joined_gap,
}


def test_states_actions_images_and_counts_equal_the_recording(loaded: dict[str, Loaded]) -> None:
    assert differences(loaded["right"]) == []


@pytest.mark.parametrize("defect", DEFECTS)
def test_a_planted_defect_is_found(loaded: dict[str, Loaded], defect: str) -> None:
    assert differences(loaded[defect])


def test_an_episode_ends_at_a_gap_and_where_a_camera_is_lost(loaded: dict[str, Loaded]) -> None:
    facts = loaded["right"].facts
    # 0.5 s to the gap, the gap to 3.0 s; 3.2 s to the lost camera, the camera again to 7.9 s.
    assert facts["num_episodes"] == 4
    lengths = [len(list(frames)) for _, frames in groupby(expected_frames(), key=lambda frame: frame.episode)]
    assert [episode["length"] for episode in facts["episodes"]] == lengths
    assert facts["num_frames"] == sum(lengths)


def test_labels_are_tasks_and_outcomes_are_success(loaded: dict[str, Loaded]) -> None:
    facts, arrays = loaded["right"].facts, loaded["right"].arrays
    assert facts["tasks"] == [EPISODES[frame.marked]["label"] for frame in expected_frames()]
    # The first marked episode succeeded; its second part contains its end.
    assert facts["successful"] == [1]
    successes = np.flatnonzero(arrays["next.success"])
    assert successes.tolist() == [facts["episodes"][1]["dataset_to_index"] - 1]


def test_metadata_name_robot_joints_rate_and_statistics(loaded: dict[str, Loaded]) -> None:
    facts, arrays = loaded["right"].facts, loaded["right"].arrays
    assert (facts["fps"], facts["robot_type"]) == (FPS, "ur5")
    assert facts["names"] == {key: ["base.pos", "elbow.pos"] for key in ("observation.state", "action")}
    assert facts["mean_action"] == pytest.approx(arrays["action"].astype(np.float64).mean(axis=0).tolist())
    for mean in facts["mean_image"].values():
        assert np.shape(mean) == (3, 1, 1)
        assert 0 < np.min(mean) < np.max(mean) < 1


def test_a_robot_with_one_joint_and_no_camera_is_one_episode(loaded: dict[str, Loaded]) -> None:
    arrays, facts = loaded["one-joint"].arrays, loaded["one-joint"].facts
    rows = [ONE_JOINT.row(frame * 50 // FPS) for frame in range(30)]
    assert arrays["action"].tolist() == np.array([row.applied_rad[0] for row in rows], dtype=np.float32).tolist()
    assert (facts["num_episodes"], set(facts["tasks"])) == (1, {"operate arm"})


def test_the_export_states_units_and_source(tmp_path: Path) -> None:
    write_session(tmp_path / "recording", Session(periods=50))
    arguments = ["--recording", tmp_path / "recording", "--format", "lerobot", "--output", tmp_path / "dataset"]
    assert program.main(["export", *map(str, arguments)]) == 0
    source = json.loads((tmp_path / "dataset" / "meta" / "telescope.json").read_text())
    assert source["units"]["action"].startswith("rad")
    assert (source["device"], source["epoch"], source["simulated"]) == ("arm", 6, True)
