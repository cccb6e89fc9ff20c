"""Enrolment with the agent's key, claim codes and unpairing."""

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
from tests.harness.cloud.cloud import Cloud, Person, problem
from tests.harness.cloud.memory import Memory

Pair = tuple[Person, Robot]


@pytest.fixture
def clock(memory: Memory) -> MovingClock:
    return memory.clock


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
            {"aud": "telescope/session"}, {"aud": None}, {"iss": "telescope"}, {"iss": None}, {"jti": None},
            {"exp": None}, {"exp": 1}, {"exp": "never"}, {"exp": "4000000000"}, {"exp": 1e308}, {"exp": float("inf")},
            {"iat": None}, {"iat": 0}, {"iat": "0"}, {"iat": [1]}, {"iat": float("nan")},
            {"iat": 4_000_000_000, "exp": 4_000_000_030},
        ],
        ids=str,
    )  # fmt: skip
    def test_invalid_agent_tokens_are_refused(self, alone: Cloud, claims: dict[str, Any]) -> None:
        robot = alone.robot()
        robot.enroll()
        answer = robot.request("GET", "/agents/enrollment", token=robot.token(**claims))
        problem(answer, 401, "unauthorized")
        answer = robot.request("POST", "/agents/enroll", token=robot.token(**claims), json=robot.introduction())
        problem(answer, 401, "unauthorized")

    def test_an_agent_cannot_enroll_with_anothers_key(self, alone: Cloud) -> None:
        robot, thief = alone.robot(), alone.robot()
        answer = thief.request("POST", "/agents/enroll", json=thief.introduction(public_key=robot.public))
        problem(answer, 401, "unauthorized")
        assert "Enroll" in problem(thief.request("GET", "/agents/enrollment"), 401, "unauthorized")["detail"]

    @pytest.mark.parametrize(
        "changes",
        [
            *(
                {"devices": [{"name": name, "kind": "arm", "robot_type": "ur5", "label": ""} for name in names]}
                for names in ([], ["a", "a"], ["a/b"], ["x" * 33], [f"d{number}" for number in range(65)])
            ),
            {"name": ""}, {"public_key": "x"}, {"public_key": "!" * 43}, {"software": "x" * 201},
            {"protocol": {"min": 2, "max": 1}},
        ],
        ids=lambda changes: str(changes)[:50],
    )  # fmt: skip
    def test_invalid_enrollments_are_refused(self, alone: Cloud, changes: dict[str, Any]) -> None:
        problem(alone.robot().enroll(**changes), 422, "invalid")

    def test_waiting_for_the_claim_ends_when_the_agent_is_claimed(self, alone: Cloud) -> None:
        robot, anna = alone.robot(), alone.sign_in("anna")
        code = robot.code()
        headers = {"Authorization": f"Bearer {robot.token()}"}
        answer = anna.begin("GET", "/agents/enrollment", params={"wait_ms": 30_000}, headers=headers)
        assert robot.enrollment(wait_ms=250)["state"] == "waiting"
        claimed = anna.post("/agents/claim", {"code": code}).json()
        state = answer().json()
        assert (state["state"], state["space"]) == ("claimed", claimed["space"])
        assert state["account"] == {"id": anna.account, "name": "anna"}
        assert all(signing.key_id(signing.public_key(key["public"])) == key["id"] for key in state["keys"])

    def test_enrolling_again_updates_the_devices_and_keeps_the_owner(self, alone: Cloud) -> None:
        robot, anna = alone.robot(), alone.sign_in("anna")
        robot.pair(anna)
        devices = robot.introduction()["devices"] + [{"name": "cam", "kind": "camera", "robot_type": "c", "label": "C"}]
        answer = robot.enroll(devices=devices)
        assert (answer.status_code, answer.json()["claim_code"]) == (200, None)
        assert [item["name"] for item in anna.get("/devices").json()["items"]] == ["arm", "cam"]


class TestClaim:
    def test_it_adds_the_devices_to_the_account(self, alone: Cloud) -> None:
        robot, anna = alone.robot("left", "right"), alone.sign_in("anna")
        body = anna.post("/agents/claim", {"code": robot.code().lower().replace("-", " ")}).json()
        assert [device["id"] for device in body["devices"]] == robot.devices
        device = body["devices"][0]
        assert device["topic"] == f"ts/v1/{body['space']}/{robot.id}/left"
        assert (device["role"], device["online"], device["lease"]) == ("owner", False, None)
        (agent,) = anna.get("/agents").json()["items"]
        assert (agent["id"], agent["devices"]) == (robot.id, ["left", "right"])

    def test_wrong_used_and_expired_codes_get_the_same_response(self, alone: Cloud, clock: MovingClock) -> None:
        bert = alone.sign_in("bert")
        used, last = alone.robot().code(), alone.robot().code()
        assert bert.post("/agents/claim", {"code": used}).status_code == 200
        clock.advance(299)
        assert bert.post("/agents/claim", {"code": last}).status_code == 200
        expired = alone.robot().code()
        clock.advance(300)
        anna = alone.sign_in("anna")
        answers = [anna.post("/agents/claim", {"code": code}) for code in ("BCDF-GHJK", "nonsense", used, expired)]
        bodies = [problem(answer, 404, "claim-code-unknown") for answer in answers]
        assert all(body == bodies[0] for body in bodies)

    def test_five_wrong_codes_block_the_account_for_five_minutes(self, alone: Cloud, clock: MovingClock) -> None:
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

    def test_five_wrong_codes_block_the_address_for_all_accounts(self, alone: Cloud, clock: MovingClock) -> None:
        for number in range(5):
            guesser = alone.sign_in(f"guesser{number}", address="10.0.0.9")
            problem(guesser.post("/agents/claim", {"code": "BCDF-GHJK"}), 404, "claim-code-unknown")
        late = alone.sign_in("late", address="10.0.0.9")
        for _ in range(8):
            answer = late.post("/agents/claim", {"code": alone.robot().code()})
            problem(answer, 429, "too-many-tries")
        moved = alone.sign_in("late", address="10.0.0.10")
        assert moved.post("/agents/claim", {"code": alone.robot().code()}).status_code == 200, (
            "attempts while blocked are not counted"
        )
        clock.advance(300)
        assert late.post("/agents/claim", {"code": alone.robot().code()}).status_code == 200

    @pytest.mark.parametrize("accounts", [1, 10])
    def test_concurrent_guesses_are_limited_too(self, alone: Cloud, accounts: int) -> None:
        guessers = [alone.sign_in(f"guesser{number}", address="10.0.0.9") for number in range(accounts)]
        answers = [
            guesser.begin("POST", "/agents/claim", json={"code": "BCDF-GHJK"})
            for guesser in guessers
            for _ in range(30 // accounts)
        ]
        statuses = [answer().status_code for answer in answers]
        assert 1 <= statuses.count(404) <= 5
        assert set(statuses) <= {404, 429, 503}

    @pytest.mark.parametrize(
        ("client", "proxies", "forwarded", "found"),
        [
            ("10.0.0.1", 0, [], "10.0.0.1"), ("10.0.0.1", 0, ["1.1.1.1"], "10.0.0.1"),
            ("10.0.0.1", 1, [], "10.0.0.1"), ("10.0.0.1", 1, ["1.1.1.1"], "1.1.1.1"),
            ("10.0.0.1", 1, ["6.6.6.6, 1.1.1.1"], "1.1.1.1"), ("10.0.0.1", 1, ["1.1.1.1:4711"], "1.1.1.1"),
            ("10.0.0.1", 1, ["::ffff:1.1.1.1"], "1.1.1.1"), ("10.0.0.1", 1, ["<script>"], ""),
            ("10.0.0.1", 1, ["[2001:db8::1]:4711"], "2001:db8::/64"), ("fe80::1%eth0", 0, [], "fe80::/64"),
            ("10.0.0.1", 1, ["2001:db8:0:0:ffff::1"], "2001:db8::/64"), (None, 0, [], ""),
            ("10.0.0.1", 2, ["6.6.6.6, 1.1.1.1", "2.2.2.2"], "1.1.1.1"), (None, 0, ["6.6.6.6, 1.1.1.1:1"], "1.1.1.1"),
        ],
    )  # fmt: skip
    def test_client_address_behind_proxies(
        self, client: str | None, proxies: int, forwarded: list[str], found: str
    ) -> None:
        headers = [(b"x-forwarded-for", line.encode()) for line in forwarded]
        scope = {"type": "http", "client": client and (client, 1), "headers": headers}
        assert client_address(Request(scope), proxies) == found

    def test_only_an_own_space_can_be_chosen(self, alone: Cloud) -> None:
        anna, bert = alone.sign_in("anna"), alone.sign_in("bert")
        code = alone.robot().code()
        (foreign,) = bert.get("/spaces").json()["items"]
        (own,) = anna.get("/spaces").json()["items"]
        problem(anna.post("/agents/claim", {"code": code, "space": foreign["id"]}), 404, "space-unknown")
        answer = anna.post("/agents/claim", {"code": code, "space": own["id"]})
        assert answer.json()["space"] == own["id"]


def test_lists_are_paged_by_agent(alone: Cloud) -> None:
    anna = alone.sign_in("anna")
    for _ in range(7):
        alone.robot("a", "b").pair(anna)  # correct codes are not counted as attempts
    for path, each in (("/agents", 1), ("/devices", 2)):
        pages = anna.each_page(path, limit=2)
        assert [len(page) for page in pages] == [2 * each] * 3 + [each]
        assert len({item["id"] for page in pages for item in page}) == 7 * each
        problem(anna.get(path, params={"cursor": "§"}), 422, "cursor-invalid")


def test_unpairing_disconnects_the_agent_and_hides_its_data(
    cloud: Cloud, anna: Person, robot: Robot, broker: MemoryBroker
) -> None:
    epoch = anna.take_lease(robot.device).json()["epoch"]
    action = anna.start(robot.device, epoch=epoch, wait_ms=10_000).json()["id"]
    issued = robot.request("POST", "/mqtt/credentials", json={"purpose": "agent"}).json()
    link = robot.link
    assert link is not None
    assert anna.delete(f"/agents/{robot.id}").status_code == 204
    assert link.disconnected.is_set()
    late = broker.connect(issued["client_id"], Credentials(issued["username"], issued["password"]))
    assert not late.connected.is_set()
    late.close()
    assert robot.commands[-1].epoch > epoch, "the former holder is fenced"
    problem(anna.get(f"/actions/{action}"), 404, "action-unknown")
    assert anna.get("/agents").json()["items"] == anna.get("/devices").json()["items"] == []
    problem(anna.delete(f"/agents/{robot.id}"), 404, "agent-unknown")
    problem(robot.request("POST", "/mqtt/credentials", json={"purpose": "agent"}), 409, "agent-unclaimed")
    assert robot.enrollment()["state"] == "waiting"

    bert = cloud.sign_in("bert")
    robot.pair(bert)
    robot.connect()
    started = bert.start(robot.device, wait_ms=10_000)
    assert started.status_code == 200, "the action of an earlier owner does not occupy the slot"
    assert started.json()["epoch"] > epoch
    problem(bert.get(f"/actions/{action}"), 404, "action-unknown")


def test_an_idempotency_key_of_an_earlier_pairing_starts_a_new_action(anna: Person, robot: Robot) -> None:
    first = anna.start(robot.device, idempotency_key="k", wait_ms=10_000).json()["id"]
    anna.delete(f"/agents/{robot.id}")
    robot.pair(anna)
    robot.connect()
    again = anna.start(robot.device, idempotency_key="k", wait_ms=10_000)
    assert again.status_code == 200
    assert again.json()["id"] != first
    assert anna.action(again.json()["id"])["status"] == "started"


class TestCertificates:
    def test_none_is_issued_for_a_broker_without_certificates(self, alone: Cloud) -> None:
        robot = alone.robot()
        robot.pair(alone.sign_in("anna"))
        answer = robot.request("POST", "/agents/certificate", json={"request": "x"})
        problem(answer, 409, "certificates-unused")

    def test_a_claimed_agent_gets_one_that_unpairing_revokes(
        self, alone: Cloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        devices.create(tmp_path / "tls", now=dt.datetime.now(dt.UTC))
        authority = FileCertificates(tmp_path / "tls")
        monkeypatch.setattr(alone.functions.agent_certificates, "_certificates", authority)
        anna, robot = alone.sign_in("anna"), alone.robot()
        robot.enroll()
        key = ec.generate_private_key(ec.SECP256R1())
        request = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
        body = {"request": request.public_bytes(serialization.Encoding.PEM).decode()}
        problem(robot.request("POST", "/agents/certificate", json=body), 409, "agent-unclaimed")
        robot.pair(anna)
        problem(robot.request("POST", "/agents/certificate", json={"request": "x"}), 422, "invalid")
        made = robot.request("POST", "/agents/certificate", json=body)
        assert made.status_code == 200, made.text
        certificate = x509.load_pem_x509_certificate(made.json()["chain"].encode())
        assert certificate.subject.rfc4514_string() == f"CN={robot.id}"

        leave: Any = alone.functions.unpair._offboarding
        monkeypatch.setattr(leave, "_certificates", authority)
        assert anna.delete(f"/agents/{robot.id}").status_code == 204
        revoked = x509.load_pem_x509_crl((tmp_path / "tls" / "devices.crl").read_bytes())
        assert revoked.get_revoked_certificate_by_serial_number(certificate.serial_number) is not None
