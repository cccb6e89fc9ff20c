"""Enrolment by the agent's own key, claim codes, un-pairing."""

import datetime as dt
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from fastapi import Request

from device_agent.protocol.security import signing
from function_app.adapters.local.certificates import FileCertificates
from function_app.entrypoints.http.framework.client_address import client_address
from function_app.ports.broker_access import Credentials
from infra.tls import agent_ca as devices
from tests.fakes.agent import Robot
from tests.fakes.broker import MemoryBroker
from tests.fakes.clock import MovingClock
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, Cloud, Person, paired, problem
from tests.harness.cloud.memory import Memory
from tests.harness.network.brokers import wait_until

Pair = tuple[Person, Robot]


@pytest.fixture
def clock(memory: Memory) -> MovingClock:
    return memory.clock


@pytest.fixture
def alone(open_cloud: OpenCloud) -> Cloud:
    """The functions where no broker is needed, with a clock that moves."""
    return open_cloud()


class TestEnroll:
    def test_an_agent_gets_its_id_and_a_code_of_five_minutes(self, alone: Cloud) -> None:
        robot = alone.robot()
        answer = robot.enroll()
        body = answer.json()
        assert (answer.status_code, body["agent"]) == (201, robot.id)
        assert 280 <= body["expires_in_s"] <= 300
        assert len(body["claim_code"]) == 9
        assert robot.enrollment() | {"keys": [], "signing_key": ""} == {
            "agent": robot.id,
            "state": "waiting",
            "space": None,
            "account": None,
            "keys": [],
            "key_statements": [],
            "signing_key": "",
        }

    def test_the_same_key_is_the_same_agent_with_a_new_code(self, alone: Cloud) -> None:
        robot = alone.robot()
        first, second = robot.enroll().json(), robot.enroll(name="other").json()
        assert first["agent"] == second["agent"]
        assert first["claim_code"] != second["claim_code"]
        anna = alone.sign_in("anna")
        problem(anna.post("/agents/claim", {"code": first["claim_code"]}), 404, "claim-code-unknown")
        assert anna.post("/agents/claim", {"code": second["claim_code"]}).status_code == 200

    @pytest.mark.parametrize(
        "claims",
        [
            pytest.param({"key": signing.generate()}, id="another key"),
            {"aud": "telescope/session"},
            {"aud": None},
            {"iss": "telescope"},
            {"iss": None},
            {"exp": None},
            {"iat": None},
            {"jti": None},
            {"exp": 1},
            {"iat": 4_000_000_000, "exp": 4_000_000_030},
            {"iat": 0},
            {"exp": "never"},
            {"exp": "4000000000"},
            {"iat": "0"},
            {"iat": [1]},
            {"exp": 1e308},
            {"iat": float("nan")},
            {"exp": float("inf")},
        ],
        ids=str,
    )
    def test_a_token_that_its_key_did_not_sign_for_this_now_is_refused(
        self, alone: Cloud, claims: dict[str, Any]
    ) -> None:
        robot = alone.robot()
        robot.enroll()
        answer = robot.ask("GET", "/agents/enrollment", token=robot.token(**claims))
        problem(answer, 401, "unauthorized")
        answer = robot.ask("POST", "/agents/enroll", token=robot.token(**claims), json=robot.introduction())
        problem(answer, 401, "unauthorized")

    def test_an_agent_cannot_enroll_with_anothers_key(self, alone: Cloud) -> None:
        robot, thief = alone.robot(), alone.robot()
        answer = thief.ask("POST", "/agents/enroll", json=thief.introduction(public_key=robot.public))
        problem(answer, 401, "unauthorized")

    def test_an_agent_that_is_not_enrolled_is_told_to(self, alone: Cloud) -> None:
        body = problem(alone.robot().ask("GET", "/agents/enrollment"), 401, "unauthorized")
        assert "Enroll" in body["detail"]

    @pytest.mark.parametrize(
        "changes",
        [
            {"devices": []},
            {"devices": [{"name": "a", "kind": "arm", "robot_type": "ur5", "label": ""}] * 2},
            {"devices": [{"name": "a/b", "kind": "arm", "robot_type": "ur5", "label": ""}]},
            {"devices": [{"name": "x" * 33, "kind": "arm", "robot_type": "ur5", "label": ""}]},
            {"devices": [{"name": f"d{n}", "kind": "a", "robot_type": "ur5", "label": ""} for n in range(65)]},
            {"name": ""},
            {"public_key": "x"},
            {"public_key": "!" * 43},
            {"software": "x" * 201},
            {"space": "mine"},
        ],
        ids=lambda changes: str(changes)[:50],
    )
    def test_an_introduction_that_is_wrong_is_refused(self, alone: Cloud, changes: dict[str, Any]) -> None:
        problem(alone.robot().enroll(**changes), 422, "invalid")

    def test_waiting_for_the_claim_ends_with_it(self, alone: Cloud) -> None:
        robot, anna = alone.robot(), alone.sign_in("anna")
        code = robot.code()
        headers = {"Authorization": f"Bearer {robot.token()}"}
        answer = anna.begin("GET", "/agents/enrollment", params={"wait_ms": 30_000}, headers=headers)
        assert robot.enrollment(wait_ms=250)["state"] == "waiting"
        claimed = anna.post("/agents/claim", {"code": code}).json()
        found = answer().json()
        assert (found["state"], found["space"]) == ("claimed", claimed["space"])
        assert found["account"] == {"id": anna.account, "name": "anna"}
        assert [signing.key_id(signing.public_key(key["public"])) for key in found["keys"]] == [
            key["id"] for key in found["keys"]
        ]

    def test_a_claimed_agent_that_enrolls_again_keeps_its_owner_and_tells_its_devices(self, alone: Cloud) -> None:
        robot, anna = alone.robot(), alone.sign_in("anna")
        robot.pair(anna)
        devices = robot.introduction()["devices"] + [{"name": "cam", "kind": "camera", "robot_type": "c", "label": "C"}]
        answer = robot.enroll(devices=devices)
        assert (answer.status_code, answer.json()["claim_code"]) == (200, None)
        assert [item["name"] for item in anna.get("/devices").json()["items"]] == ["arm", "cam"]


class TestClaim:
    def test_it_makes_the_devices_the_accounts(self, alone: Cloud) -> None:
        robot, anna = alone.robot("left", "right"), alone.sign_in("anna")
        body = anna.post("/agents/claim", {"code": robot.code().lower().replace("-", " ")}).json()
        assert [device["id"] for device in body["devices"]] == robot.devices
        device = body["devices"][0]
        assert device["topic"] == f"ts/v1/{body['space']}/{robot.id}/left"
        assert (device["role"], device["online"], device["lease"]) == ("owner", False, None)
        (agent,) = anna.get("/agents").json()["items"]
        assert (agent["id"], agent["devices"]) == (robot.id, ["left", "right"])

    def test_a_wrong_a_used_and_an_expired_code_are_answered_alike(self, alone: Cloud, clock: MovingClock) -> None:
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert")
        used, expired, last = alone.robot().code(), "", alone.robot().code()
        assert bert.post("/agents/claim", {"code": used}).status_code == 200
        clock.advance(299)
        assert bert.post("/agents/claim", {"code": last}).status_code == 200
        expired = alone.robot().code()
        clock.advance(300)
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert")
        answers = [anna.post("/agents/claim", {"code": code}) for code in ("BCDF-GHJK", "nonsense", used, expired)]
        bodies = [problem(answer, 404, "claim-code-unknown") for answer in answers]
        assert all(body == bodies[0] for body in bodies)

    def test_after_five_wrong_tries_even_the_right_code_waits(self, alone: Cloud, clock: MovingClock) -> None:
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert", address="10.0.0.2")
        robot = alone.robot()
        for _ in range(5):
            problem(anna.post("/agents/claim", {"code": "BCDF-GHJK"}), 404, "claim-code-unknown")
        answer = anna.post("/agents/claim", {"code": robot.code()})
        problem(answer, 429, "too-many-tries")
        assert 290 <= int(answer.headers["retry-after"]) <= 300
        elsewhere = alone.sign_in("anna", address="10.0.0.3")
        problem(elsewhere.post("/agents/claim", {"code": robot.code()}), 429, "too-many-tries")
        assert bert.post("/agents/claim", {"code": alone.robot().code()}).status_code == 200
        clock.advance(300)
        assert alone.sign_in("anna").post("/agents/claim", {"code": robot.code()}).status_code == 200

    def test_an_address_has_five_wrong_tries_over_all_callers(self, alone: Cloud, clock: MovingClock) -> None:
        for number in range(5):
            guesser = alone.sign_in(f"guesser{number}", address="10.0.0.9")
            problem(guesser.post("/agents/claim", {"code": "BCDF-GHJK"}), 404, "claim-code-unknown")
        late = alone.sign_in("late", address="10.0.0.9")
        for _ in range(8):
            answer = late.post("/agents/claim", {"code": alone.robot().code()})
            problem(answer, 429, "too-many-tries")
        moved = alone.sign_in("late", address="10.0.0.10")
        assert moved.post("/agents/claim", {"code": alone.robot().code()}).status_code == 200, "none of those counted"
        clock.advance(300)
        assert late.post("/agents/claim", {"code": alone.robot().code()}).status_code == 200

    def test_parallel_guesses_from_one_address_are_no_way_around(self, alone: Cloud) -> None:
        guessers = [alone.sign_in(f"guesser{number}", address="10.0.0.9") for number in range(10)]
        answers = [
            guesser.begin("POST", "/agents/claim", json={"code": "BCDF-GHJK"}) for guesser in guessers for _ in range(3)
        ]
        statuses = [answer().status_code for answer in answers]
        assert 1 <= statuses.count(404) <= 5
        assert set(statuses) <= {404, 429, 503}

    @pytest.mark.parametrize(
        ("client", "proxies", "forwarded", "found"),
        [
            ("10.0.0.1", 0, [], "10.0.0.1"),
            ("10.0.0.1", 0, ["1.1.1.1"], "10.0.0.1"),
            ("10.0.0.1", 1, ["1.1.1.1"], "1.1.1.1"),
            ("10.0.0.1", 1, ["6.6.6.6, 1.1.1.1"], "1.1.1.1"),
            ("10.0.0.1", 2, ["6.6.6.6, 1.1.1.1", "2.2.2.2"], "1.1.1.1"),
            ("10.0.0.1", 1, [], "10.0.0.1"),
            ("10.0.0.1", 1, ["1.1.1.1:4711"], "1.1.1.1"),
            ("10.0.0.1", 1, ["[2001:db8::1]:4711"], "2001:db8::/64"),
            ("10.0.0.1", 1, ["2001:db8:0:0:ffff::1"], "2001:db8::/64"),
            ("10.0.0.1", 1, ["::ffff:1.1.1.1"], "1.1.1.1"),
            ("10.0.0.1", 1, ["<script>"], ""),
            ("fe80::1%eth0", 0, [], "fe80::/64"),
            (None, 0, ["6.6.6.6, 1.1.1.1:4711"], "1.1.1.1"),
            (None, 0, [], ""),
        ],
    )
    def test_whose_address_it_is(self, client: str | None, proxies: int, forwarded: list[str], found: str) -> None:
        headers = [(b"x-forwarded-for", line.encode()) for line in forwarded]
        scope = {"type": "http", "client": client and (client, 1), "headers": headers}
        assert client_address(Request(scope), proxies) == found

    def test_right_codes_are_not_counted(self, alone: Cloud) -> None:
        anna = alone.sign_in("anna")
        for _ in range(8):
            assert anna.post("/agents/claim", {"code": alone.robot().code()}).status_code == 200
        assert len(anna.get("/agents").json()["items"]) == 8

    def test_parallel_guesses_are_no_way_around(self, alone: Cloud) -> None:
        anna = alone.sign_in("anna")
        answers = [anna.begin("POST", "/agents/claim", json={"code": "BCDF-GHJK"}) for _ in range(30)]
        statuses = [answer().status_code for answer in answers]
        assert statuses.count(404) <= 5
        assert set(statuses) <= {404, 429}

    def test_a_space_of_ones_own_may_be_chosen_and_no_other(self, alone: Cloud) -> None:
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert")
        code = alone.robot().code()
        (foreign,) = bert.get("/spaces").json()["items"]
        (own,) = anna.get("/spaces").json()["items"]
        problem(anna.post("/agents/claim", {"code": code, "space": foreign["id"]}), 404, "space-unknown")
        answer = anna.post("/agents/claim", {"code": code, "space": own["id"]})
        assert answer.json()["space"] == own["id"]


def test_the_lists_page_agent_by_agent(alone: Cloud) -> None:
    anna = alone.sign_in("anna")
    for _ in range(5):
        alone.robot("a", "b").pair(anna)
    for path, each in (("/agents", 1), ("/devices", 2)):
        found: list[str] = []
        cursor: str | None = None
        for _ in range(3):
            page = anna.get(path, params={"limit": 2} | ({"cursor": cursor} if cursor else {})).json()
            found += [item["id"] for item in page["items"]]
            cursor = page["cursor"]
        assert cursor is None
        assert len(set(found)) == len(found) == 5 * each
        problem(anna.get(path, params={"cursor": "§"}), 422, "cursor-invalid")


def test_unpairing_cuts_the_agent_and_leaves_nothing_of_it(cloud: Cloud, pair: Pair, broker: MemoryBroker) -> None:
    anna, robot = pair
    epoch = anna.take(robot.device).json()["epoch"]
    action = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
    issued = robot.ask("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
    link = robot.link
    assert link is not None
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    wait_until(link.disconnected.is_set, "the cut")
    late = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert not late.connected.is_set()
    late.close()
    assert robot.commands[-1].epoch > epoch, "the former holder is fenced"
    for path in (f"/devices/{robot.device}", f"/devices/{robot.device}/actions", f"/actions/{action}"):
        assert anna.get(path).status_code == 404
    assert anna.get("/agents").json()["items"] == anna.get("/devices").json()["items"] == []
    problem(anna.delete(f"/agents/{robot.id}"), 404, "agent-unknown")
    problem(robot.ask("POST", "/mqtt/credentials", json={"purpose": "agent"}), 409, "agent-unclaimed")
    assert robot.enrollment()["state"] == "waiting"

    bert = cloud.sign_in("bert")
    robot.pair(bert)
    robot.connect()
    wait_until(lambda: bert.get(f"/devices/{robot.device}").json()["online"], "the robot to be online")
    assert bert.get(f"/devices/{robot.device}/actions").json()["items"] == []
    assert bert.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    started = bert.start(robot.device, wait_ms=10_000)
    assert started.status_code == 200, "an earlier owner's action does not hold the slot"
    assert started.json()["epoch"] > epoch
    problem(bert.get(f"/actions/{action}"), 404, "action-unknown")


def test_an_idempotency_key_of_an_earlier_pairing_starts_anew(pair: Pair) -> None:
    anna, robot = pair
    first = anna.start(robot.device, once="k", wait_ms=10_000).json()["id"]
    anna.delete(f"/agents/{robot.id}")
    assert robot.link is not None
    wait_until(robot.link.disconnected.is_set, "the cut")
    robot.pair(anna)
    robot.connect()
    wait_until(lambda: anna.get(f"/devices/{robot.device}").json()["online"], "the robot to be online")
    again = anna.start(robot.device, once="k", wait_ms=10_000)
    assert again.status_code == 200
    assert again.json()["id"] != first
    assert anna.action(again.json()["id"])["status"] == "started"


def test_two_agents_of_two_owners_are_apart(cloud: Cloud) -> None:
    with paired(cloud, "anna") as (anna, one), paired(cloud, "bert") as (bert, two):
        assert [item["id"] for item in anna.get("/devices").json()["items"]] == [one.device]
        assert [item["id"] for item in bert.get("/devices").json()["items"]] == [two.device]
        assert cloud.ask("GET", f"{API}/devices").status_code == 401


class TestCertificates:
    def test_where_the_broker_wants_none_none_is_made(self, alone: Cloud) -> None:
        robot = alone.robot()
        robot.pair(alone.sign_in("anna"))
        answer = robot.ask("POST", "/agents/certificate", json={"request": "x"})
        problem(answer, 409, "certificates-unused")

    def test_an_agent_that_is_claimed_gets_one_and_loses_it_with_its_pairing(
        self, alone: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        devices.create(tmp_path / "tls", now=dt.datetime.now(dt.UTC))
        authority = FileCertificates(tmp_path / "tls")
        monkeypatch.setattr(alone.functions.agent_certificates, "_certificates", authority)
        anna, robot = alone.sign_in("anna"), alone.robot()
        robot.enroll()
        key = ec.generate_private_key(ec.SECP256R1())
        request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
        asked = {"request": request.public_bytes(serialization.Encoding.PEM).decode()}
        problem(robot.ask("POST", "/agents/certificate", json=asked), 409, "agent-unclaimed")
        robot.pair(anna)
        problem(robot.ask("POST", "/agents/certificate", json={"request": "x"}), 422, "invalid")
        made = robot.ask("POST", "/agents/certificate", json=asked)
        assert made.status_code == 200, made.text
        certificate = x509.load_pem_x509_certificate(made.json()["chain"].encode())
        assert certificate.subject.rfc4514_string() == f"CN={robot.id}"

        leave: Any = alone.functions.unpair._offboarding
        monkeypatch.setattr(leave, "_certificates", authority)
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        revoked = x509.load_pem_x509_crl((tmp_path / "tls" / "devices.crl").read_bytes())
        assert revoked.get_revoked_certificate_by_serial_number(certificate.serial_number) is not None
