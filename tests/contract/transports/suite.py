"""Contract of the agent's transports, tested against the real functions.

A test class inherits ``TransportSuite`` and sets ``spoken``. If the transport connects to neither the server nor the
broker, the class overrides the fixture ``processes`` and adds its endpoint to ``processes.endpoints``.
"""

import contextlib
import itertools
import json
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pytest

from device_agent.ports import threads
from device_agent.protocol import Ack, AckStatus, Event, Fault, Measurements, Mode, State, codec, topics
from function_app.domain.common.ids import command_id
from function_app.ports.command_bus import BusUnavailable
from tests.harness.agent.thread_crashes import crash
from tests.harness.cloud.cloud_processes import CloudProcesses, Link
from tests.harness.network.brokers import BrokerKind, wait_until

ODD = '{"b" : "grüß 🤖 \\u00fc\\n\\"\\\\", "a":1.50,\t"c": [ ]}'.encode()
"""JSON in a notation that no encoder of the project writes."""
STOPS_WITHIN_S = 10.0
"""Generous for a slow machine, but shorter than a long poll, which ``stop`` interrupts [s]."""


@dataclass(frozen=True, kw_only=True)
class Spoken:
    """One transport.

    Attributes:
        configuration: Its part of ``agent.toml``.
        endpoint: Other end of its connection, one of ``processes.endpoints``.
        notices_s: Time in which it detects a network that drops all data while something moves [s].
        broker: Broker of the cloud.
    """

    configuration: Mapping[str, Any] = field(default_factory=dict)
    endpoint: str
    notices_s: float
    broker: BrokerKind = "amqtt"


class TransportSuite:
    """Contract of a transport."""

    spoken: Spoken

    def test_publishing_is_possible_once_the_agent_is_online(self, processes: CloudProcesses, link: Link) -> None:
        assert not link.transport.publish(link.topic(topics.STATE), b"{}", qos=1)
        link.start().up()
        wait_until(lambda: link.presences() == [(True, link.sessions)], "one presence")
        wait_until(lambda: processes.anna.get(f"/devices/{link.robot.device}").json()["online"], "the cloud to know")
        assert link.changes == [True]

    def test_commands_arrive_unchanged_in_order_and_expired_ones_do_not(
        self, processes: CloudProcesses, link: Link
    ) -> None:
        with contextlib.suppress(BusUnavailable):  # the embedded broker rejects a retained command
            processes.publish_retained(link.topic(topics.CMD), b'{"retained":1}')
        processes.send(link.robot, b'{"expired":1}', in_ms=1)
        time.sleep(0.01)
        link.start().up()
        commands = [ODD, *(b'{"number":%d}' % number for number in range(20)), b'{"large":"%s"}' % (b"x" * 120_000)]
        for command in commands:
            processes.send(link.robot, command)
        wait_until(lambda: commands[-1] in dict.fromkeys(payload for _, payload in link.received), "the last one")
        assert list(dict.fromkeys(payload for _, payload in link.received)) == commands
        assert {topic for topic, _ in link.received} == {link.topic(topics.CMD)}

    def test_events_arrive_unchanged_in_order_and_are_acknowledged_once(self, link: Link) -> None:
        link.start().up()
        events = [_reformat(codec.encode(_event(number, "x" * (30_000 if number == 3 else 1)))) for number in range(20)]
        acknowledged: list[int] = []
        for number, payload in enumerate(events):
            assert link.publish(topics.EVENT, payload, partial(acknowledged.append, number))
        wait_until(lambda: len(acknowledged) == len(events), "all acknowledgements")
        wait_until(lambda: len(link.published(topics.EVENT)) == len(events), "all events")
        assert link.published(topics.EVENT) == events
        assert sorted(acknowledged) == list(range(len(events)))

    def test_a_thread_that_crashed_can_be_started_again(self, processes: CloudProcesses, link: Link) -> None:
        others = threads.watched()
        link.quiet = False
        link.start().up()
        own = [thread for thread in threads.watched() if thread not in others]
        for number, thread in enumerate(own):
            crash(thread, wake=partial(processes.send, link.robot, b'{"before":%d}' % number))
            assert thread.failed
            thread.start()
            _require_both_directions(processes, link, number)
        assert own

    def test_the_largest_retained_message_arrives(self, processes: CloudProcesses, link: Link) -> None:
        link.start().up()
        fault = Fault(code="tested", message="x" * 2000, since_ms=_now_ms())
        message = State(device="arm", at_ms=_now_ms(), tick_ms=1, mode=Mode.IDLE, epoch=0, faults=(fault,))
        state = _reformat(codec.encode(message))
        state = b"{" + b" " * (codec.MAX_RETAINED_BYTES - len(state)) + state[1:]
        acknowledged = threading.Event()
        assert link.transport.publish(link.topic(topics.STATE), state, qos=1, retain=True, delivered=acknowledged.set)
        wait_until(acknowledged.is_set, "the acknowledgement")
        wait_until(lambda: link.published(topics.STATE) == [state], "the state")
        with processes.viewer(link.robot.id) as late:
            messages = [late.receive(), late.receive()]
            assert state in [message.payload for message in messages if message.retain]

    def test_many_measurements_delay_no_acknowledged_message(self, link: Link) -> None:
        link.start().up()
        acknowledged: list[int] = []
        acks = [codec.encode(_ack(link, number)) for number in range(30)]
        for number, ack in enumerate(acks):
            for sequence in range(100):
                link.publish_measurement(100 * number + sequence)
            assert link.publish(topics.ACK, ack, partial(acknowledged.append, number))
        wait_until(lambda: sorted(acknowledged) == list(range(30)), "all acknowledgements")
        wait_until(lambda: len(link.published(topics.ACK)) == len(acks), "all acks")
        assert link.published(topics.ACK) == acks
        wait_until(lambda: _sequences(link)[-1:] == [2999], "the newest measurement, which replaces older ones")
        assert _sequences(link) == sorted(set(_sequences(link)))

    def test_many_threads_and_delivery_callbacks_may_publish(self, link: Link) -> None:
        link.start().up()
        acknowledged: list[str] = []

        def publish(name: str, *following: str) -> None:
            def delivered() -> None:
                acknowledged.append(name)
                if following:
                    publish(*following)

            assert link.publish(topics.EVENT, codec.encode(_event(len(acknowledged), name)), delivered)

        threads = [threading.Thread(target=publish, args=(f"{each}", f"{each}a", f"{each}b")) for each in range(5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        wait_until(lambda: len(acknowledged) == 15, "all acknowledgements")
        assert link.changes == [True]

    def test_it_reconnects_after_the_other_end_was_killed(
        self, processes: CloudProcesses, link: Link, spoken: Spoken
    ) -> None:
        link.start().up()
        processes.endpoints[spoken.endpoint].kill()
        wait_until(lambda: link.changes == [True, False], "the loss")
        assert not link.publish(topics.ACK, codec.encode(_ack(link, 1)))
        processes.endpoints[spoken.endpoint].revive()
        link.up(2)
        assert link.sessions >= 2, "each connection has a unique number"
        processes.send(link.robot, ODD)
        wait_until(lambda: (link.topic(topics.CMD), ODD) in link.received, "a command over the new link")
        assert link.changes == [True, False, True]

    def test_cut_connections_lose_no_acknowledged_message(self, fragile: Link) -> None:
        fragile.start().up()
        assert fragile.proxy is not None
        acknowledged: set[int] = set()
        events = {number: codec.encode(_event(number)) for number in range(60)}
        for turn in range(200):
            # Like the runtime: messages without acknowledgement are sent again.
            for number in sorted(events.keys() - acknowledged):
                fragile.publish(topics.EVENT, events[number], partial(acknowledged.add, number))
            if turn < 3:
                fragile.proxy.cut()
            deadline_s = time.monotonic() + 3
            while acknowledged < events.keys() and time.monotonic() < deadline_s and fragile.changes[-1]:
                time.sleep(0.01)
            if acknowledged >= events.keys():
                break
            fragile.up(fragile.changes.count(True) + (not fragile.changes[-1]))
        assert acknowledged == events.keys()
        wait_until(lambda: set(fragile.published(topics.EVENT)) == set(events.values()), "all events")
        assert all(after is not before for before, after in itertools.pairwise(fragile.changes))

    @pytest.mark.long
    def test_a_network_that_drops_all_data_is_detected(self, fragile: Link, spoken: Spoken) -> None:
        fragile.quiet = False
        fragile.start().up()
        assert fragile.proxy is not None
        time.sleep(1)
        began_s = time.monotonic()
        fragile.proxy.swallow()
        wait_until(lambda: fragile.changes[:2] == [True, False], "the loss", 4 * spoken.notices_s)
        assert fragile.changed_s[1] - began_s < spoken.notices_s + 2
        fragile.up(2)

    @pytest.mark.parametrize("change", ["unpaired", "moved"])
    def test_an_agent_without_its_pairing_disconnects(self, processes: CloudProcesses, link: Link, change: str) -> None:
        link.start().up()
        if change == "unpaired":
            assert processes.anna.delete(f"/agents/{link.robot.id}").status_code == 204
        else:
            attic = processes.anna.post("/spaces", {"name": f"Attic of {link.robot.id}"}).json()["id"]
            assert processes.anna.put(f"/agents/{link.robot.id}/space", {"space": attic}).status_code == 200

        def detected() -> bool:
            link.publish_measurement(1)  # some transports detect only on sending that the pairing is invalid
            time.sleep(0.05)
            return link.membership.outdated.is_set()

        wait_until(detected, "the invalid pairing to be detected")
        wait_until(lambda: link.changes[-1] is False, "the end of the link")

    def test_stop_delivers_pending_messages_and_leaves_no_threads(self, link: Link) -> None:
        link.start().up()
        last = codec.encode(_ack(link, 7))
        assert link.publish(topics.ACK, last)
        began_s = time.monotonic()
        link.transport.stop()
        duration_s = time.monotonic() - began_s
        assert link.changes == [True, False]
        assert not link.publish(topics.ACK, b"{}")
        wait_until(lambda: link.presences()[-1:] == [(False, link.sessions)], "the offline presence of this session")
        assert link.published(topics.ACK) == [last]
        wait_until(lambda: not link.threads(), f"the end of {link.threads()}")
        assert duration_s < STOPS_WITHIN_S
        link.transport.stop()
        assert link.changes == [True, False]

    def test_without_a_server_it_keeps_trying_until_it_is_stopped(self, fragile: Link) -> None:
        proxy = fragile.proxy
        assert proxy is not None
        proxy.refuse()
        fragile.start()
        wait_until(lambda: proxy.accepted >= 3, "three attempts")
        began_s = time.monotonic()
        fragile.transport.stop()
        assert time.monotonic() - began_s < STOPS_WITHIN_S
        wait_until(lambda: not fragile.threads(), f"the end of {fragile.threads()}")
        assert fragile.changes == []


def _event(number: int, text: str = "x") -> Event:
    return Event(
        id=f"event-{number}-{text[:9]}", device="arm", at_ms=_now_ms(), kind="tested", severity="info", message="x",
        data={"text": text, "number": number},
    )  # fmt: skip


def _ack(link: Link, number: int) -> Ack:
    command = command_id(link.robot.device, _now_ms() + number)
    return Ack(id=command, status=AckStatus.DONE, sequence=1, at_ms=_now_ms(), tick_ms=1)


def _sequences(link: Link) -> list[int]:
    return [codec.decode(payload, Measurements).sequence for payload in link.published(topics.TELE)]


def _reformat(payload: bytes) -> bytes:
    """The same JSON in an unusual notation."""
    return json.dumps(json.loads(payload), indent=1, ensure_ascii=True).replace("\n", " \t\r\n").encode()


def _now_ms() -> int:
    return time.time_ns() // 1_000_000


def _require_both_directions(processes: CloudProcesses, link: Link, number: int) -> None:
    """Wait until an event is acknowledged, and a command that is sent then arrives."""
    acknowledged, event = threading.Event(), codec.encode(_event(number, "x"))
    wait_until(lambda: link.publish(topics.EVENT, event, acknowledged.set), "the link")
    wait_until(acknowledged.is_set, "an acknowledgement")
    command = b'{"after":%d}' % number
    processes.send(link.robot, command)
    wait_until(lambda: any(payload == command for _, payload in link.received), "a command")
