"""Commands of the wrapper for legacy robots, against a fake cloud over HTTP."""

import contextlib
import errno
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from device_agent.protocol import (
    CancelAction,
    Description,
    Event,
    GrantLease,
    MoveJoints,
    Presence,
    ReleaseLease,
    RequestControl,
    ResetStop,
    RotateKey,
    RunBehaviour,
    Say,
    State,
    StopDevice,
    WithdrawRequest,
    codec,
)
from device_agent.protocol.security import signing
from device_agent.protocol.security.key_rotation import KEYS_CONTEXT, NewKey
from tests.harness.hosts.host import interpreter
from tests.harness.network.brokers import wait_until
from tests.harness.network.http_server import serve
from tests.unit.examples.legacy_cloud import WRAPPER, LegacyCloud, handler_of, load_wrapper

legacy = load_wrapper()
WAVE, COUNT = RunBehaviour(name="wave"), RunBehaviour(name="count")
LATER_MS = 10**9


@pytest.fixture
def cloud(tmp_path: Path) -> Iterator[LegacyCloud]:
    cloud = LegacyCloud()
    with serve(handler_of(cloud)) as cloud.url:
        cloud.write_home(tmp_path / "home")
        yield cloud


class RunningRobot:
    """A robot in a thread of this process, with the behaviours ``wave``, which ends, and ``count``, which does not.

    Attributes:
        calls: Names of the started functions.
        error: What ended ``run``.
    """

    def __init__(self, home: Path, **options: Any) -> None:
        self.calls: list[str] = []
        self.error: Exception | None = None
        self.blocked = threading.Event()
        self.blocked.set()
        self.robot = legacy.Robot(str(home), **options)
        self.robot.on("wave", self._wave).on("count", self._count).on("say", self._say)
        self._thread = threading.Thread(target=self._run)

    def _wave(self, action: Any) -> None:
        self.calls.append("wave")
        action.print("waves \ud800")

    def _count(self, action: Any) -> None:
        self.calls.append("count")
        action.ended.wait()
        self.blocked.wait()

    def _say(self, action: Any) -> dict[str, Any]:
        self.calls.append("say")
        text = action.parameters["text"]
        if text == "exit":
            raise SystemExit
        return {"text": text * 40_000 if text == "long" else float("nan") if text == "nan" else text}

    def _run(self) -> None:
        try:
            self.robot.run()
        except legacy.LegacyError as error:
            self.error = error

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def wait(self) -> None:
        self._thread.join(30)
        assert not self._thread.is_alive()

    def __exit__(self, *_: object) -> None:
        self.blocked.set()
        self.robot.stop()
        self.wait()


@pytest.fixture
def robot(cloud: LegacyCloud, tmp_path: Path) -> Iterator[RunningRobot]:
    with RunningRobot(tmp_path / "home") as robot:
        wait_until(lambda: cloud.of(State), "the connection")
        yield robot


@pytest.mark.parametrize("version", ["3.6", "3.13"])
def test_signed_forged_repeated_and_expired_commands(cloud: LegacyCloud, tmp_path: Path, version: str) -> None:
    python = interpreter(version)
    (tmp_path / "step.py").write_text("open('steps', 'a').write('step\\n')\n")
    step = RunBehaviour(name="step")
    command = [python, str(WRAPPER), "run", "--home", str(tmp_path / "home"), "--movements", str(tmp_path)]

    @contextlib.contextmanager
    def running() -> Iterator[None]:
        process = subprocess.Popen(command, stderr=subprocess.PIPE)
        try:
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            _, log = process.communicate(timeout=60)
        assert process.returncode == 0, log

    with running():
        signed = cloud.sign(step, id="signed")
        cloud.put(signed.replace(b'"step"', b'"stop"'))
        cloud.put(cloud.sign(step, key=signing.generate()))
        cloud.put(cloud.sign(step, device="other"))
        cloud.put(b"{}")
        wait_until(lambda: cloud.rejections() == {"bad_signature", "wrong_address", "malformed"}, "the rejections")
        cloud.put(signed, "signed")
        assert cloud.end("signed") == ("done", "")
        assert cloud.end(cloud.send(step, issued_at_ms=cloud.now_ms() - 60_000)) == ("expired", "expired")
        assert cloud.end(cloud.send(step, issued_at_ms=cloud.now_ms() + 60_000)) == ("failed", "from_the_future")
        assert cloud.end(cloud.send(step, epoch=0)) == ("failed", "stale_epoch")
        assert cloud.end(cloud.send(RunBehaviour(name="other"))) == ("failed", "cannot")
        cloud.put(signed, "signed")
        wait_until(lambda: len(cloud.acks("signed")) > 3, "the repeated answer")
    with running():
        answers = len(cloud.acks("signed"))
        cloud.put(signed, "signed")
        wait_until(lambda: len(cloud.acks("signed")) > answers, "the repeated answer")
        assert cloud.last("signed") == ("done", "")
    assert (tmp_path / "steps").read_text() == "step\n"
    assert [ack.status for ack in cloud.acks("signed")][:3] == ["accepted", "started", "done"]
    assert not cloud.of(Presence)[-1].online


def test_the_description_lists_the_behaviours_and_the_requests(cloud: LegacyCloud, robot: RunningRobot) -> None:
    (description,) = cloud.of(Description)
    assert (description.behaviours, description.actions) == (("count", "wave"), ("run_behaviour", "say"))
    assert not description.streaming
    said = cloud.send(Say(text="Ahoj"))
    assert cloud.end(said) == ("done", "")
    assert cloud.acks(said)[-1].result["text"] == "Ahoj"
    assert cloud.end(cloud.send(RunBehaviour(name="say"))) == ("failed", "cannot")
    assert cloud.end(cloud.send(MoveJoints(position_rad={"head": 1.0}))) == ("failed", "cannot")
    assert robot.calls == ["say"]


def test_output_and_results_that_cannot_be_sent_are_replaced(cloud: LegacyCloud, robot: RunningRobot) -> None:
    wave = cloud.send(WAVE)
    assert cloud.end(wave) == ("done", "")
    assert cloud.acks(wave)[-1].output == "waves ?"
    for text in ("long", "nan", "exit"):
        assert cloud.end(cloud.send(Say(text=text))) == ("failed", "script_failed")
    assert cloud.end(cloud.send(WAVE)) == ("done", "")
    assert len(robot.calls) == 5


def test_one_action_runs_at_a_time_and_a_cancel_names_it(cloud: LegacyCloud, robot: RunningRobot) -> None:
    count = cloud.send(COUNT)
    wait_until(lambda: cloud.last(count)[0] == "started", "the action")
    assert cloud.end(cloud.send(WAVE)) == ("failed", "busy")
    assert cloud.end(cloud.send(CancelAction(action="another"))) == ("failed", "not_running")
    assert cloud.end(cloud.send(CancelAction(action=count))) == ("done", "")
    assert cloud.end(count) == ("cancelled", "cancelled")
    assert robot.calls == ["count"]


def test_a_stop_is_confirmed_when_the_function_has_returned(cloud: LegacyCloud, robot: RunningRobot) -> None:
    robot.blocked.clear()
    count = cloud.send(COUNT)
    wait_until(lambda: cloud.last(count)[0] == "started", "the action")
    stop = cloud.send(StopDevice(), issued_at_ms=cloud.now_ms() - LATER_MS)
    wait_until(lambda: cloud.of(State)[-1].stop is not None, "the latch")
    wait_until(lambda: cloud.of(State)[-1].faults, "the fault")
    assert cloud.of(State)[-1].faults[0].code == "not_stopping"
    assert cloud.of(State)[-1].mode == "action"
    assert not any(ack.status.terminal for ack in cloud.acks(stop))
    robot.blocked.set()
    assert cloud.end(stop) == ("done", "")
    assert cloud.end(count) == ("failed", "stopped")
    wait_until(lambda: cloud.of(State)[-1].mode == "stopped", "the state")
    assert cloud.end(cloud.send(WAVE, epoch=2)) == ("failed", "stopped")
    assert cloud.end(cloud.send(ResetStop(), epoch=1)) == ("failed", "stale_epoch")
    assert cloud.end(cloud.send(ResetStop(), epoch=3)) == ("done", "")
    assert cloud.end(cloud.send(WAVE, epoch=3)) == ("failed", "lease_ended")
    assert cloud.end(cloud.send(WAVE, epoch=4)) == ("done", "")


def test_a_command_that_was_rejected_for_its_epoch_runs_with_a_higher_one(
    cloud: LegacyCloud, robot: RunningRobot
) -> None:
    assert cloud.end(cloud.send(WAVE, epoch=5)) == ("done", "")
    repeated = cloud.send(WAVE, epoch=4)
    assert cloud.end(repeated) == ("failed", "stale_epoch")
    (ack,) = cloud.acks(repeated)
    assert ack.reason is not None
    assert ack.reason.epoch == 5
    cloud.send(WAVE, id=repeated, epoch=6)
    wait_until(lambda: cloud.last(repeated)[0] == "done", "the command with a higher epoch")
    assert robot.calls == ["wave", "wave"]


@pytest.mark.parametrize("ending", ["release", "expiry", "newer lease"])
def test_the_end_of_a_lease_ends_its_action(cloud: LegacyCloud, robot: RunningRobot, ending: str) -> None:
    lease_ms = 400 if ending == "expiry" else 60_000
    cloud.send(GrantLease(holder="anna", lease_ms=lease_ms))
    count = cloud.send(COUNT)
    wait_until(lambda: cloud.last(count)[0], "the action")
    if ending == "release":
        cloud.send(ReleaseLease())
    elif ending == "newer lease":
        cloud.send(GrantLease(holder="bert", lease_ms=lease_ms), epoch=2)
    assert cloud.end(count) == ("failed", "lease_lost")
    assert cloud.end(cloud.send(COUNT)) == ("failed", "stale_epoch" if ending == "newer lease" else "lease_ended")
    assert robot.calls == ["count"]


def test_the_state_shows_the_lease_and_a_request_for_control(cloud: LegacyCloud, robot: RunningRobot) -> None:
    cloud.send(GrantLease(holder="anna", lease_ms=60_000))
    cloud.send(RequestControl(request="r1", requester="bert", answer_within_ms=60_000))
    wait_until(lambda: cloud.of(State)[-1].lease and cloud.of(State)[-1].lease.request, "the request")
    assert (cloud.of(State)[-1].lease.holder, cloud.of(State)[-1].lease.request.requester) == ("anna", "bert")
    cloud.send(WithdrawRequest(request="r1"))
    wait_until(lambda: cloud.of(State)[-1].lease.request is None, "the end of the request")
    assert robot.calls == []


def test_an_action_ends_without_a_response_of_the_cloud(cloud: LegacyCloud, tmp_path: Path) -> None:
    with RunningRobot(tmp_path / "home", lost_after_s=0.5):
        count = cloud.send(COUNT)
        wait_until(lambda: cloud.last(count)[0] == "started", "the action")
        cloud.silent.set()
        journal = tmp_path / "home" / "journal.jsonl"
        wait_until(lambda: "link_lost" in journal.read_text(), "the end of the action")
        cloud.silent.clear()
        assert cloud.end(count) == ("failed", "link_lost")


def test_a_restart_ends_the_lease_and_never_runs_a_command_again(cloud: LegacyCloud, tmp_path: Path) -> None:
    signed = cloud.sign(COUNT, id="count-1")
    with RunningRobot(tmp_path / "home") as robot:
        cloud.put(signed, "count-1")
        wait_until(lambda: cloud.last("count-1")[0] == "started", "the action")
        copy = (tmp_path / "home" / "journal.jsonl").read_text()
    assert cloud.end("count-1") == ("failed", "agent_stopping")
    (tmp_path / "home" / "journal.jsonl").write_text(copy + '{"incomplete')  # as after SIGKILL
    cloud.messages.clear()
    with RunningRobot(tmp_path / "home") as robot:
        cloud.put(signed, "count-1")
        assert cloud.end("count-1") == ("failed", "agent_restarted")
        assert cloud.end(cloud.send(WAVE)) == ("failed", "lease_ended")
        assert cloud.end(cloud.send(WAVE, epoch=2)) == ("done", "")
        assert robot.calls == ["wave"]
    assert [event.data["stopped"] for event in cloud.of(Event) if event.kind == "agent-started"] == [False]


def test_the_end_of_an_action_is_reported_with_a_full_disk(
    cloud: LegacyCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RunningRobot(tmp_path / "home") as robot:
        count = cloud.send(COUNT)
        wait_until(lambda: cloud.last(count)[0] == "started", "the action")
        cloud_cancel = cloud.sign(CancelAction(action=count))
        put = legacy.Journal.put

        def full(journal: Any, changes: dict[str, Any]) -> None:
            if any("ack" in (value or {}) and value["ack"]["status"] == "cancelled" for value in changes.values()):
                raise legacy.LegacyError(os.strerror(errno.ENOSPC))
            put(journal, changes)

        monkeypatch.setattr(legacy.Journal, "put", full)
        cloud.put(cloud_cancel, "cancel")
        assert cloud.end(count) == ("cancelled", "cancelled")
        robot.wait()
        assert str(robot.error) == os.strerror(errno.ENOSPC)


def test_a_wrong_clock_of_the_robot_has_no_effect(cloud: LegacyCloud, tmp_path: Path) -> None:
    cloud.offset_ms = LATER_MS
    with RunningRobot(tmp_path / "home", report_s=0.0) as robot:
        assert cloud.end(cloud.send(WAVE)) == ("done", "")
        assert robot.calls == ["wave"]
        wait_until(lambda: cloud.samples, "response times")
        assert min(cloud.samples) > 0


# ---------------------------------------------------------------- keys of the cloud


def statement(new: Ed25519PrivateKey, by: Ed25519PrivateKey, serial: int, end_ms: int) -> str:
    key = NewKey(serial=serial, key=signing.public_text(new.public_key()), former_until_ms=end_ms)
    return signing.sign(codec.encode(key), by, context=KEYS_CONTEXT).decode()


def test_a_new_key_is_followed_and_the_old_one_expires(cloud: LegacyCloud, tmp_path: Path) -> None:
    old, new = cloud.key, signing.generate()
    with RunningRobot(tmp_path / "home"):
        chain = (statement(new, old, 2, cloud.now_ms() + LATER_MS),)
        assert cloud.end(cloud.send(RotateKey(statements=chain))) == ("done", "")
        assert cloud.end(cloud.send(WAVE, key=new)) == ("done", "")
        assert cloud.end(cloud.send(WAVE, key=old)) == ("done", "")
    cloud.statements = [*chain]
    cloud.offset_ms = 2 * LATER_MS
    with RunningRobot(tmp_path / "home") as robot:
        cloud.send(WAVE, key=old, epoch=2)
        wait_until(lambda: "bad_signature" in cloud.rejections(), "the rejection")
        assert cloud.end(cloud.send(WAVE, key=new, epoch=2)) == ("done", "")
        assert robot.calls == ["wave"]


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda _, new, end_ms: statement(new, new, 2, end_ms), "bad_signature"),
        (lambda old, new, _: statement(new, old, 2, 1), "expired"),
        (lambda *_: "[", "malformed"),
        (lambda *_: "{}", "malformed"),
    ],
)
def test_a_statement_without_a_valid_signer_changes_nothing(
    cloud: LegacyCloud, robot: RunningRobot, make: Callable[..., str], code: str, tmp_path: Path
) -> None:
    before = (tmp_path / "home" / "agent.json").read_text()
    text = make(cloud.key, signing.generate(), cloud.now_ms() + LATER_MS)
    assert cloud.end(cloud.send(RotateKey(statements=(text,))))[1] == code
    assert (tmp_path / "home" / "agent.json").read_text() == before
    assert robot.calls == []


@pytest.mark.usefixtures("cloud")
def test_two_movements_cannot_have_one_name(tmp_path: Path) -> None:
    (tmp_path / "movements").mkdir()
    for name in ("wave.py", "wave.sh"):
        (tmp_path / "movements" / name).write_text("")
        (tmp_path / "movements" / name).chmod(0o755)
    robot = legacy.Robot(str(tmp_path / "home"))
    with pytest.raises(legacy.LegacyError, match="two movements have the name 'wave'"):
        robot.on_files(str(tmp_path / "movements"))
