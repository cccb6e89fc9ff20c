"""Killed and restarted programs: no command runs twice, and no accepted message is lost."""

from device_agent.protocol import AckStatus, MoveJoints, StopDevice
from tests.harness.cloud.cloud import Person
from tests.harness.network.brokers import wait_until
from tests.harness.network.xmpp import XmppRobot, XmppSite, start_prosody


def test_a_second_gateway_takes_over_and_no_agent_is_served_twice(
    site: XmppSite, anna: Person, robot: XmppRobot
) -> None:
    second = site.start_gateway()
    try:
        robots = [robot]
        for number in range(3):
            other = site.robot(f"arm{number}")
            other.pair(anna)
            robots.append(other.connect())
        first = site.gateways[0]
        for each in robots:
            assert first.serves(each.id) != second.serves(each.id)
        first.end()
        site.gateways.remove(first)
        wait_until(lambda: all(second.serves(each.id) for each in robots), "all agents at the second gateway")
        for each in robots:
            wait_until(lambda each=each: each.changes[-1], "the link")  # type: ignore[misc]
            assert anna.take_lease(each.device, wait_ms=10_000).json()["confirmed"]
            assert all(len(payloads) == 1 for payloads in each.payloads.values()), "a command was sent twice"
    finally:
        for each in robots[1:]:
            each.__exit__()


def test_a_stop_without_a_gateway_is_delivered_later(site: XmppSite, anna: Person, robot: XmppRobot) -> None:
    site.gateways.pop().end()
    wait_until(lambda: robot.changes[-1] is False, "the loss of the link")
    wait_until(lambda: not anna.get(f"/devices/{robot.device}").json()["online"], "offline")
    assert anna.post(f"/devices/{robot.device}/stop").json()["outcome"] == "unreachable"
    site.start_gateway()
    wait_until(lambda: robot.changes[-1] is True, "the new link")
    wait_until(lambda: robot.received(StopDevice), "the delayed Stop")
    assert robot.session >= 2


def test_all_connections_recover_after_the_server_was_killed(site: XmppSite, anna: Person, robot: XmppRobot) -> None:
    robot.silent = True
    action = anna.start(robot.device).json()["id"]
    wait_until(lambda: robot.received(MoveJoints), "the command")
    site.prosody.kill()
    wait_until(lambda: robot.changes[-1] is False, "the loss")
    # Without Prosody no robot can confirm. The command waits in the gateway and arrives with the new link.
    assert anna.post(f"/devices/{robot.device}/stop").status_code == 202
    robot.silent = False
    with start_prosody(site.prosody.home, f"{site.url}/api/v1/xmpp/verify", port=site.prosody.port) as again:
        site.prosody.process = again.process
        wait_until(lambda: robot.changes[-1] is True, "the new link")
        wait_until(lambda: robot.received(StopDevice), "the Stop")
        wait_until(lambda: anna.get(f"/devices/{robot.device}").json()["online"], "online again")
        again_stopped = anna.post(f"/devices/{robot.device}/stop")
        assert (again_stopped.status_code, again_stopped.json()["outcome"]) == (200, "confirmed")
        robot.report(action, AckStatus.STARTED)
        robot.report(action, AckStatus.DONE)
        assert anna.action(action, wait_ms=10_000, wait_for="done")["status"] == "done"
        assert len(robot.received(MoveJoints)) == 1, "the repeated command ran twice"
        assert len(set(robot.payloads[action])) == 1
