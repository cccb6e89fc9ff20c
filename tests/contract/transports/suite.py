"""What every transport promises, between a transport as the agent builds it and the functions as people start them.

A transport's test inherits the class and says what is ``spoken``; where that ends neither at the server nor at the
broker, it overrides the fixture ``ground`` and brings the end in ``ground.endpoints``.
"""

import json
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pytest

from device_agent.protocol import Ack, AckStatus, Event, Fault, Measurements, Mode, State, codec, topics
from function_app.domain.common.ids import command_id
from tests.harness.cloud.cloud_processes import Ground, Link
from tests.harness.network.brokers import BrokerKind, wait_until

ODD = '{"b" : "grüß 🤖 \\u00fc\\n\\"\\\\", "a":1.50,\t"c": [ ]}'.encode()
"""JSON as none of our own encoders writes it."""
STOPS_WITHIN_S = 10.0
"""A second, and what a slow machine needs to notice; a long poll, which it cuts short, lasts much longer."""


@dataclass(frozen=True, kw_only=True)
class Spoken:
    """One transport.

    Attributes:
        configuration: Its part of ``agent.toml``.
        endpoint: What its connection ends at, one of ``ground.endpoints``.
        notices_s: How soon it notices, while something moves, that a network swallows everything.
        stores: Whether what was confirmed is in the cloud's tables: a broker confirms for itself alone.
        broker: Which broker is there.
    """

    configuration: Mapping[str, Any] = field(default_factory=dict)
    endpoint: str
    notices_s: float
    stores: bool = False
    broker: BrokerKind = "amqtt"


class TransportSuite:
    """Inherited by each."""

    spoken: Spoken

    # ------------------------------------------------------------ what arrives, both ways

    def test_it_is_up_when_it_can_hear_and_has_said_that_it_is_there(self, ground: Ground, link: Link) -> None:
        assert not link.transport.publish(link.topic(topics.STATE), b"{}", qos=1), "not before it is up"
        link.start().up()
        wait_until(lambda: link.presences() == [(True, link.sessions)], "its presence, once")
        device = link.robot.device
        wait_until(lambda: ground.anna.get(f"/devices/{device}").json()["online"], "the cloud to know")
        ground.send(link.robot, ODD)
        wait_until(lambda: link.received, "an order")
        assert link.changes == [True]

    def test_orders_arrive_byte_for_byte_and_in_order(self, ground: Ground, link: Link) -> None:
        link.start().up()
        large = b'{"large":"%s"}' % (b"x" * 120_000)
        orders = [ODD, *(b'{"number":%d}' % number for number in range(20)), large]
        for order in orders:
            ground.send(link.robot, order)
        wait_until(lambda: len({payload for _, payload in link.received}) == len(orders), "all of them")
        assert list(dict.fromkeys(payload for _, payload in link.received)) == orders
        assert {topic for topic, _ in link.received} == {link.topic(topics.CMD)}

    def test_what_is_told_arrives_byte_for_byte_in_order_and_is_confirmed_once(self, link: Link) -> None:
        link.start().up()
        told = [_odd(codec.encode(_event(number, "x" * (30_000 if number == 3 else 1)))) for number in range(20)]
        confirmed: list[int] = []
        for number, payload in enumerate(told):
            assert link.transport.publish(
                link.topic(topics.EVENT), payload, qos=1, delivered=partial(confirmed.append, number)
            )
        wait_until(lambda: len(confirmed) == len(told), "all confirmations")
        wait_until(lambda: len(link.heard(topics.EVENT)) == len(told), "all of them")
        assert link.heard(topics.EVENT) == told
        assert sorted(confirmed) == list(range(len(told)))

    def test_the_largest_that_may_be_retained_arrives(self, ground: Ground, link: Link) -> None:
        link.start().up()
        state = _odd(codec.encode(_state("x" * 2000)))
        state = b"{" + b" " * (codec.MAX_RETAINED_BYTES - len(state)) + state[1:]
        confirmed: list[bool] = []
        topic = link.topic(topics.STATE)
        assert link.transport.publish(topic, state, qos=1, retain=True, delivered=lambda: confirmed.append(True))
        wait_until(lambda: confirmed, "the confirmation")
        wait_until(lambda: link.heard(topics.STATE) == [state], "the state")
        with ground.ear(link.robot.id) as late:
            kept = [late.receive(), late.receive()]
            assert state in [message.payload for message in kept if message.retain]

    def test_measurements_in_masses_cost_no_answer(self, link: Link) -> None:
        link.start().up()
        confirmed: list[int] = []
        answers = [codec.encode(_ack(link, number)) for number in range(30)]
        for number, answer in enumerate(answers):
            for sequence in range(100):
                link.transport.publish(
                    link.topic(topics.TELE, "load"), codec.encode(_measured(100 * number + sequence)), qos=0
                )
            assert link.transport.publish(
                link.topic(topics.ACK), answer, qos=1, delivered=partial(confirmed.append, number)
            )
        wait_until(lambda: sorted(confirmed) == list(range(30)), "all confirmations")
        wait_until(lambda: len(link.heard(topics.ACK)) == len(answers), "all answers")
        assert link.heard(topics.ACK) == answers
        wait_until(lambda: _sequences(link)[-1:] == [2999], "the newest measurement: it wins over older ones")
        assert _sequences(link) == sorted(set(_sequences(link)))

    def test_many_threads_and_delivery_callbacks_may_publish(self, link: Link) -> None:
        link.start().up()
        confirmed: list[str] = []

        def publish(name: str, *then: str) -> None:
            def note() -> None:
                confirmed.append(name)
                if then:
                    publish(*then)

            payload = codec.encode(_event(len(confirmed), name))
            assert link.transport.publish(link.topic(topics.EVENT), payload, qos=1, delivered=note)

        threads = [threading.Thread(target=publish, args=(f"{each}", f"{each}a", f"{each}b")) for each in range(5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        wait_until(lambda: len(confirmed) == 15, "all confirmations")
        assert link.changes == [True]

    # ------------------------------------------------------------ what must not be obeyed

    def test_an_order_from_before_whose_time_is_over_is_not_given(self, ground: Ground, link: Link) -> None:
        ground.keep(link.topic(topics.CMD), b'{"kept":1}')
        ground.send(link.robot, b'{"old":1}', in_ms=1)
        time.sleep(0.01)
        link.start().up()
        ground.send(link.robot, b'{"new":1}')
        wait_until(lambda: (link.topic(topics.CMD), b'{"new":1}') in link.received, "the new one")
        assert {payload for _, payload in link.received} == {b'{"new":1}'}

    # ------------------------------------------------------------ the link goes, and comes back

    def test_it_comes_back_by_itself_after_what_it_speaks_to_was_killed(
        self, ground: Ground, link: Link, spoken: Spoken
    ) -> None:
        link.start().up()
        ground.endpoints[spoken.endpoint].kill()
        wait_until(lambda: link.changes == [True, False], "the loss")
        assert not link.transport.publish(link.topic(topics.ACK), codec.encode(_ack(link, 1)), qos=1)
        ground.endpoints[spoken.endpoint].revive()
        link.up(2)
        assert link.sessions >= 2, "each connection has a number of its own"
        ground.send(link.robot, ODD)
        wait_until(lambda: (link.topic(topics.CMD), ODD) in link.received, "an order over the new link")
        assert link.changes == [True, False, True]

    def test_a_cut_in_the_middle_of_telling_loses_nothing_that_was_confirmed(self, fragile: Link) -> None:
        fragile.start().up()
        assert fragile.proxy is not None
        confirmed: set[int] = set()
        said = {number: codec.encode(_event(number)) for number in range(60)}
        waiting = set(said)
        for turn in range(200):
            # As the runtime does: what was not confirmed is said again.
            for number in sorted(waiting - confirmed):
                fragile.transport.publish(
                    fragile.topic(topics.EVENT), said[number], qos=1, delivered=partial(confirmed.add, number)
                )
            if turn < 3:
                fragile.proxy.cut()
            deadline_s = time.monotonic() + 3
            while confirmed < waiting and time.monotonic() < deadline_s and fragile.changes[-1]:
                time.sleep(0.01)
            if confirmed >= waiting:
                break
            fragile.up(fragile.changes.count(True) + (not fragile.changes[-1]))
        assert confirmed == waiting
        wait_until(lambda: set(fragile.heard(topics.EVENT)) == set(said.values()), "all of them")
        assert all(up is not before for before, up in zip(fragile.changes, fragile.changes[1:], strict=False))

    @pytest.mark.long
    def test_a_network_that_swallows_everything_is_noticed_and_left_behind(self, fragile: Link, spoken: Spoken) -> None:
        fragile.quiet = False
        fragile.start().up()
        assert fragile.proxy is not None
        time.sleep(1)
        began_s = time.monotonic()
        fragile.proxy.swallow()
        wait_until(lambda: fragile.changes[:2] == [True, False], "the loss", 4 * spoken.notices_s)
        assert fragile.changed_s[1] - began_s < spoken.notices_s + 2
        fragile.up(2)

    # ------------------------------------------------------------ whose it is

    def test_an_agent_that_was_unpaired_learns_it(self, ground: Ground, link: Link) -> None:
        link.start().up()
        assert ground.anna.delete(f"/agents/{link.robot.id}").status_code == 204
        self._say_something_until(link, link.membership.outdated.is_set)
        wait_until(lambda: link.changes[-1] is False, "the end of the link")

    def test_an_agent_that_was_moved_learns_it(self, ground: Ground, link: Link) -> None:
        link.start().up()
        attic = ground.anna.post("/spaces", {"name": f"Attic of {link.robot.id}"}).json()["id"]
        assert ground.anna.put(f"/agents/{link.robot.id}/space", {"space": attic}).status_code == 200
        self._say_something_until(link, link.membership.outdated.is_set)
        wait_until(lambda: link.changes[-1] is False, "the end of the link")

    # ------------------------------------------------------------ the end

    def test_it_says_goodbye_and_leaves_nothing_running(self, link: Link) -> None:
        link.start().up()
        last = codec.encode(_ack(link, 7))
        assert link.transport.publish(link.topic(topics.ACK), last, qos=1)
        began_s = time.monotonic()
        link.transport.stop()
        took_s = time.monotonic() - began_s
        assert link.changes == [True, False]
        assert not link.transport.publish(link.topic(topics.ACK), b"{}", qos=1)
        wait_until(lambda: link.presences()[-1:] == [(False, link.sessions)], "the goodbye, of the same session")
        assert link.heard(topics.ACK) == [last], "messages before the stop are delivered"
        wait_until(lambda: not link.threads(), f"the end of {link.threads()}")
        assert took_s < STOPS_WITHIN_S
        link.transport.stop()
        assert link.changes == [True, False]

    def test_without_a_server_it_keeps_trying_and_ends_when_told(
        self, ground: Ground, fragile: Link, spoken: Spoken
    ) -> None:
        assert fragile.proxy is not None
        del ground, spoken
        fragile.proxy.refuse()
        fragile.start()
        wait_until(lambda: fragile.proxy.accepted >= 3, "three attempts")  # type: ignore[union-attr]
        began_s = time.monotonic()
        fragile.transport.stop()
        assert time.monotonic() - began_s < STOPS_WITHIN_S
        wait_until(lambda: not fragile.threads(), f"the end of {fragile.threads()}")
        assert fragile.changes == []

    @staticmethod
    def _say_something_until(link: Link, enough: Any) -> None:
        """As agents do: some transports detect only on sending that the pairing is invalid."""

        def say() -> bool:
            link.transport.publish(link.topic(topics.TELE, "load"), codec.encode(_measured(1)), qos=0)
            time.sleep(0.05)
            return bool(enough())

        wait_until(say, "it to learn it")


def _event(number: int, text: str = "x") -> Event:
    return Event(
        id=f"event-{number}-{text[:9]}", device="arm", at_ms=_now_ms(), kind="tested", severity="info", message="x",
        data={"text": text, "number": number},
    )  # fmt: skip


def _state(text: str) -> State:
    fault = Fault(code="tested", message=text, since_ms=_now_ms())
    return State(device="arm", at_ms=_now_ms(), tick_ms=1, mode=Mode.IDLE, epoch=0, faults=(fault,))


def _ack(link: Link, number: int) -> Ack:
    return Ack(
        id=command_id(link.robot.device, _now_ms() + number),
        status=AckStatus.DONE,
        sequence=1,
        at_ms=_now_ms(),
        tick_ms=1,
    )


def _measured(sequence: int) -> Measurements:
    return Measurements(tick_ms=1, at_ms=_now_ms(), sequence=sequence, values={"temperature_c": 20.0 + sequence})


def _sequences(link: Link) -> list[int]:
    return [codec.decode(payload, Measurements).sequence for payload in link.heard(topics.TELE)]


def _odd(payload: bytes) -> bytes:
    """The same JSON in an unusual notation."""
    return json.dumps(json.loads(payload), indent=1, ensure_ascii=True).replace("\n", " \t\r\n").encode()


def _now_ms() -> int:
    return time.time_ns() // 1_000_000
