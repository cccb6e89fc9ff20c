"""Passwords of local accounts and their sign-in sessions."""

import asyncio
from typing import Any

import httpx
import pytest
from argon2 import PasswordHasher

from function_app.adapters.local import password_hasher
from function_app.domain.common.problems import Problem
from function_app.ports.tables import Row
from function_app.services.accounts import passwords
from function_app.services.storage import records
from tests.fakes.agent import Robot
from tests.harness.cloud.cloud import API, Cloud, Person, problem

GOOD, BETTER = "correct horse battery", "staple correct horse"
PASSWORD = "/accounts/me/password"
SESSIONS = "/accounts/me/sessions"


def sign_in(cloud: Cloud, name: str, password: str, *, address: str = "127.0.0.1", **more: str) -> httpx.Response:
    body = {"name": name, "password": password, **more}
    return cloud.run(cloud.client(address=address).post(f"{API}/auth/password", json=body))


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    """A person who has signed in by a link and set a password."""
    anna = cloud.sign_in("anna")
    assert anna.put(PASSWORD, {"password": GOOD}).status_code == 204
    return anna


def password_row(cloud: Cloud, account: str) -> Any:
    row = cloud.run(cloud.functions.tables.get(records.ACCOUNTS, account, "password"))
    assert row is not None
    return row.data


def test_a_password_signs_in(cloud: Cloud, anna: Person) -> None:
    answer = sign_in(cloud, "anna", GOOD)
    assert answer.status_code == 200
    assert answer.headers["cache-control"] == "no-store"
    again = Person(cloud, answer.json())
    assert (again.account, again.name) == (anna.account, "anna")
    assert again.session != anna.session
    assert "HttpOnly; SameSite=Strict" in answer.headers["set-cookie"]


def test_only_a_slow_hash_is_stored_and_renewed(cloud: Cloud, anna: Person, monkeypatch: pytest.MonkeyPatch) -> None:
    row = password_row(cloud, anna.account)
    assert row["hash"].startswith("$argon2id$v=19$m=19456,t=2,p=1$")
    assert GOOD not in str(row)
    monkeypatch.setattr(password_hasher, "PASSES", 3)
    hasher: Any = cloud.functions.passwords._hasher
    hasher._library = None
    assert sign_in(cloud, "anna", GOOD).status_code == 200
    assert "t=3" in password_row(cloud, anna.account)["hash"], "with the newer parameters"
    assert sign_in(cloud, "anna", GOOD).status_code == 200


def test_wrong_passwords_and_unknown_names_are_indistinguishable(cloud: Cloud, anna: Person) -> None:
    cloud.sign_in("carl")  # has no password
    refused = [
        problem(sign_in(cloud, name, text), 401, "unauthorized")
        for name, text in (("anna", BETTER), ("unknown", GOOD), ("carl", GOOD), ("annna", GOOD), ("anna", GOOD + " "))
    ]
    assert all(each == refused[0] for each in refused)
    assert anna.get("/accounts/me").status_code == 200


@pytest.mark.usefixtures("anna")
def test_an_unknown_name_takes_one_hash_too(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    verify = PasswordHasher.verify

    def counted(self: PasswordHasher, stored: str, text: str) -> bool:
        done.append(stored[:30])
        return verify(self, stored, text)

    monkeypatch.setattr(PasswordHasher, "verify", counted)
    for name in ("anna", "unknown"):
        sign_in(cloud, name, BETTER)
    assert len(done) == 2
    assert done[0] == done[1]


class TestNames:
    """Names that differ only in case belong to one account."""

    def test_any_spelling_signs_in_and_the_first_is_shown(self, cloud: Cloud, anna: Person) -> None:
        for name in ("ANNA", "Anna", "\uff21nna", " anna\u00a0"):
            answer = sign_in(cloud, name, GOOD)
            assert answer.status_code == 200, name
            assert answer.json()["account"] == {"id": anna.account, "name": "anna"}
        assert cloud.sign_in("bert").put(PASSWORD, {"password": "cafe\u0301 au lait noir"}).status_code == 204
        assert sign_in(cloud, "bert", "caf\u00e9 au lait noir").status_code == 200, "passwords are normalized too"
        first = cloud.sign_in("J\u00fcrgen  Wei\u00df")
        assert cloud.sign_in("JU\u0308RGEN WEISS").account == first.account
        assert cloud.sign_in("ju\u0308rgen wei\u00df").get("/accounts/me").json()["name"] == "J\u00fcrgen  Wei\u00df"

    def test_other_spellings_register_no_second_account(self, cloud: Cloud, anna: Person) -> None:
        with pytest.raises(Problem, match="Choose another"):
            cloud.run(cloud.functions.passwords.register("ANNA", BETTER))
        assert cloud.sign_in("aNNa").account == anna.account

    def test_a_device_is_shared_with_a_name_in_any_spelling(self, pair: tuple[Person, Robot]) -> None:
        owner, robot = pair
        bert = owner.cloud.sign_in("Bert")
        answer = owner.post(f"/devices/{robot.device}/shares", {"account": "BERT", "role": "viewer"})
        assert answer.status_code == 201, answer.text
        assert bert.get(f"/devices/{robot.device}").status_code == 200

    def test_an_account_with_a_legacy_name_is_found(self, cloud: Cloud) -> None:
        """Legacy rows are stored under the case-sensitive name."""
        old = {"account": "o" * 20, "space": "s" * 20}
        cloud.run(cloud.functions.tables.create(records.ACCOUNTS, Row("name:Dora", "account", old)))
        assert cloud.sign_in("Dora").account == old["account"]
        with pytest.raises(Problem, match="Choose another"):
            cloud.run(cloud.functions.passwords.register("Dora", BETTER))
        assert cloud.sign_in("dora").account != old["account"]
        assert cloud.sign_in("Dora").account == old["account"]


class TestGuessing:
    def test_ten_wrong_passwords_block_a_name_at_one_address_only(self, cloud: Cloud, anna: Person) -> None:
        for number in range(9):
            name = "".join(letter.upper() if number >> place & 1 else letter for place, letter in enumerate("anna"))
            problem(sign_in(cloud, name, "wrong", address="192.0.2.1"), 401, "unauthorized")
        assert sign_in(cloud, "anna", GOOD, address="192.0.2.1").status_code == 200, "a correct one does not count"
        problem(sign_in(cloud, "anna", "wrong", address="192.0.2.1"), 401, "unauthorized")
        answer = sign_in(cloud, "anna", GOOD, address="192.0.2.1")
        problem(answer, 429, "too-many-tries")
        assert 0 < int(answer.headers["retry-after"]) <= 300
        assert sign_in(cloud, "anna", GOOD, address="192.0.2.2").status_code == 200, "the owner at another address"
        assert anna.get("/accounts/me").status_code == 200
        cloud.clock.advance(301)
        assert sign_in(cloud, "anna", GOOD, address="192.0.2.1").status_code == 200

    @pytest.mark.usefixtures("anna")
    def test_attempts_from_many_addresses_slow_the_account_without_locking_it(
        self, cloud: Cloud, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Each attempt costs a slow hash, so the test lowers the limit."""
        monkeypatch.setattr(passwords, "SLOW_AFTER", 4)
        monkeypatch.setattr(passwords, "SLOWER_S", 1.5)
        known = sign_in(cloud, "anna", GOOD).json()["device_token"]

        def duration_s(password: str, status: int, address: str, **more: str) -> float:
            before_ms = cloud.clock.now_ms()
            assert sign_in(cloud, "anna", password, address=address, **more).status_code == status
            return (cloud.clock.now_ms() - before_ms) / 1000

        delays_s = [duration_s("wrong", 401, f"192.0.2.{number}") for number in range(8)]
        assert delays_s == pytest.approx([0, 0, 0, 0, 1.5, 3, 4, 4], abs=0.1)
        assert duration_s(GOOD, 200, "203.0.113.1") == pytest.approx(4, abs=0.1)
        assert duration_s(GOOD, 200, "203.0.113.1", device_token=known) < 0.1, "a known browser is not slowed"

    @pytest.mark.usefixtures("anna")
    def test_a_known_browser_has_its_own_limit(self, cloud: Cloud) -> None:
        known = sign_in(cloud, "anna", GOOD).json()["device_token"]
        for number in range(31):
            sign_in(cloud, f"n{number}", "wrong")
        problem(sign_in(cloud, "anna", GOOD), 429, "too-many-tries")
        assert sign_in(cloud, "anna", GOOD, device_token=known).status_code == 200
        for _ in range(10):
            problem(sign_in(cloud, "anna", "wrong", device_token=known), 401, "unauthorized")
        problem(sign_in(cloud, "anna", GOOD, device_token=known), 429, "too-many-tries")

    @pytest.mark.usefixtures("anna")
    def test_the_token_of_another_account_is_not_a_known_browser(self, cloud: Cloud) -> None:
        bert = cloud.sign_in("bert")
        assert bert.put(PASSWORD, {"password": BETTER}).status_code == 204
        other = sign_in(cloud, "bert", BETTER).json()["device_token"]
        for token in (other, "forged", bert.token):
            for _ in range(3):
                sign_in(cloud, "anna", "wrong", device_token=token)
        problem(sign_in(cloud, "anna", "wrong", device_token=other), 401, "unauthorized")
        problem(sign_in(cloud, "anna", GOOD, device_token=other), 429, "too-many-tries")

    @pytest.mark.usefixtures("anna")
    def test_an_address_has_thirty_attempts_over_all_names(self, cloud: Cloud) -> None:
        statuses = [sign_in(cloud, f"n{number}", GOOD, address="198.51.100.7").status_code for number in range(31)]
        assert statuses == [401] * 30 + [429]
        problem(sign_in(cloud, "anna", GOOD, address="198.51.100.7"), 429, "too-many-tries")
        assert sign_in(cloud, "anna", GOOD, address="198.51.100.8").status_code == 200

    def test_ten_wrong_old_passwords_block_changes(self, anna: Person) -> None:
        for _ in range(10):
            problem(anna.put(PASSWORD, {"password": BETTER, "old_password": "wrong"}), 403, "forbidden")
        problem(anna.put(PASSWORD, {"password": BETTER, "old_password": GOOD}), 429, "too-many-tries")


class TestChanging:
    def test_it_requires_the_old_password_ten_minutes_after_the_link(self, cloud: Cloud, anna: Person) -> None:
        assert anna.put(PASSWORD, {"password": BETTER}).status_code == 204
        cloud.clock.advance(600)
        problem(anna.put(PASSWORD, {"password": GOOD}), 403, "forbidden")
        assert anna.put(PASSWORD, {"password": GOOD, "old_password": BETTER}).status_code == 204
        problem(sign_in(cloud, "anna", BETTER), 401, "unauthorized")

    def test_it_ends_every_other_session(self, cloud: Cloud, anna: Person) -> None:
        others = [cloud.sign_in("anna"), Person(cloud, sign_in(cloud, "anna", GOOD).json())]
        problem(others[1].put(PASSWORD, {"password": BETTER}), 403, "forbidden")
        stranger = cloud.sign_in("bert")
        assert anna.put(PASSWORD, {"password": BETTER, "old_password": GOOD}).status_code == 204
        for other in others:
            problem(other.get("/accounts/me"), 401, "unauthorized")
        assert anna.get("/accounts/me").status_code == stranger.get("/accounts/me").status_code == 200

    def test_common_passwords_are_refused(self, anna: Person) -> None:
        for weak in (
            "", "eleven char", "aaaaaaaaaaaaaaaa", "123456789012", "qwertyuiopas", "Password1234!", "annaanna2026",
            "t3l3sc0pe-t3l3sc0pe", "x" * 257,
        ):  # fmt: skip
            problem(anna.put(PASSWORD, {"password": weak, "old_password": GOOD}), 422, "password-weak")


class TestSessions:
    def test_they_are_listed_with_method_and_address(self, cloud: Cloud, anna: Person) -> None:
        client = cloud.client(address="192.0.2.9", headers={"User-Agent": "Phone"})
        body = {"name": "anna", "password": GOOD}
        phone = cloud.run(client.post(f"{API}/auth/password", json=body)).json()["session"]
        newest, first = anna.get(SESSIONS).json()["items"]
        assert (newest["id"], newest["method"], newest["address"], newest["program"], newest["mine"]) == (
            phone, "password", "192.0.2.9", "Phone", False,
        )  # fmt: skip
        assert (first["id"], first["method"], first["mine"]) == (anna.session, "link", True)
        assert cloud.sign_in("bert").get(SESSIONS).json()["items"][0]["method"] == "link"

    def test_the_last_use_is_listed_with_address_and_program(self, cloud: Cloud, anna: Person) -> None:
        phone = cloud.sign_in("anna", address="192.0.2.9")

        def listed() -> Any:
            return {each["id"]: each for each in anna.get(SESSIONS).json()["items"]}[phone.session]

        signed_in = listed()
        assert signed_in["last_used_at"] == signed_in["created_at"]
        cloud.clock.advance(360)
        assert phone.get("/accounts/me", headers={"User-Agent": "Phone"}).status_code == 200
        used = listed()
        assert (used["address"], used["program"]) == ("192.0.2.9", "Phone")
        assert signed_in["last_used_at"] < used["last_used_at"] < used["expires_at"]
        cloud.clock.advance(60)
        phone.get("/accounts/me")
        assert listed() == used, "the resolution is five minutes"

    def test_only_recent_uses_stay_in_memory(self, cloud: Cloud) -> None:
        for _ in range(3):
            cloud.clock.advance(360)
            assert cloud.sign_in("anna").get("/accounts/me").status_code == 200
        assert len(cloud.functions.sessions._used_ms) == 1

    def test_recent_sign_ins_outlive_their_sessions(self, cloud: Cloud, anna: Person) -> None:
        first = sign_in(cloud, "anna", GOOD, address="192.0.2.9").json()
        second = Person(cloud, sign_in(cloud, "anna", GOOD, device_token=first["device_token"]).json())
        assert second.delete(f"{SESSIONS}/{first['session']}").status_code == 204
        items = anna.get("/accounts/me/sign-ins").json()["items"]
        assert [(each["session"], each["method"], each["known_browser"], each["mine"]) for each in items] == [
            (second.session, "password", True, False),
            (first["session"], "password", False, False),
            (anna.session, "link", False, True),
        ]
        assert (items[1]["address"], items[1]["program"][:12]) == ("192.0.2.9", "python-httpx")
        record = anna.get("/accounts/me/audit", params={"event": "signed-in"}).json()["items"][1]
        assert record["at"] == items[1]["at"]
        assert record["data"] == {
            "how": "password", "address": "192.0.2.9", "program": items[1]["program"], "known_browser": False,
            "second_factor": "",
        }  # fmt: skip
        cloud.clock.advance(30 * 86_400)
        newest = cloud.sign_in("anna")
        assert [each["mine"] for each in newest.get("/accounts/me/sign-ins").json()["items"]] == [True]

    def test_an_account_ends_its_own_sessions(self, cloud: Cloud, anna: Person) -> None:
        ended, *others = [cloud.sign_in("anna") for _ in range(3)]
        stranger = cloud.sign_in("bert")
        problem(stranger.delete(f"{SESSIONS}/{ended.session}"), 404, "session-unknown")
        assert anna.delete(f"{SESSIONS}/{ended.session}").status_code == 204
        problem(anna.delete(f"{SESSIONS}/{ended.session}"), 404, "session-unknown")
        assert anna.delete(SESSIONS).json() == {"ended": 2}
        for person in (ended, *others):
            problem(person.get("/accounts/me"), 401, "unauthorized")
        assert [each["mine"] for each in anna.get(SESSIONS).json()["items"]] == [True]
        assert anna.delete(SESSIONS).json() == {"ended": 0}

    def test_they_expire_after_twelve_hours(self, cloud: Cloud, anna: Person) -> None:
        cloud.clock.advance(12 * 3600)
        newest = cloud.sign_in("anna")
        assert [each["id"] for each in newest.get(SESSIONS).json()["items"]] == [newest.session]
        cloud.sweep()
        keys = [row.key for row in cloud.run(cloud.functions.tables.query(records.ACCOUNTS, anna.account)).rows]
        assert [key for key in keys if key.startswith("session:")] == [f"session:{newest.session}"]


def test_signing_out_releases_control(cloud: Cloud, anna: Person, robot: Robot) -> None:
    other = cloud.sign_in("anna")
    assert other.take_lease(robot.device, lease_ms=600_000, wait_ms=10_000).json()["confirmed"] is True
    assert other.post("/auth/sign-out").status_code == 204
    assert anna.get(f"/devices/{robot.device}/lease").json()["lease"] is None
    assert anna.take_lease(robot.device).json()["epoch"] == 2


def test_concurrent_registrations_of_a_name_create_one_account(cloud: Cloud) -> None:
    async def all_at_once() -> list[Any]:
        passwords = cloud.functions.passwords
        calls = (passwords.register("dora", f"{GOOD} {number}") for number in range(10))
        return await asyncio.gather(*calls, return_exceptions=True)

    results = cloud.run(all_at_once())
    (winner,) = [number for number, each in enumerate(results) if not isinstance(each, BaseException)]
    assert {each.code for number, each in enumerate(results) if number != winner} == {"name-taken"}
    answer = sign_in(cloud, "dora", f"{GOOD} {winner}")
    assert answer.json()["account"]["id"] == results[winner].id
    assert Person(cloud, answer.json()).get("/spaces").json()["items"]


def test_an_invitation_creates_an_account_with_the_shared_device(cloud: Cloud, pair: tuple[Person, Robot]) -> None:
    owner, robot = pair
    invitation = owner.post(f"/devices/{robot.device}/invitations", {"role": "viewer"}).json()["secret"]

    def join(invitation: str, name: str = "dora d", password: str = GOOD) -> httpx.Response:
        body = {"invitation": invitation, "name": name, "password": password}
        return cloud.request("POST", f"{API}/auth/accounts", json=body)

    problem(join("x" * 43), 404, "invitation-unknown")
    problem(join(invitation, "anna"), 409, "name-taken")
    problem(join(invitation, password="short"), 422, "password-weak")
    for name in ("", " dora", "dora ", "do\nra", "x" * 61):
        problem(join(invitation, name), 422, "invalid")
    problem(sign_in(cloud, "dora d", GOOD), 401, "unauthorized")
    answer = join(invitation)
    assert answer.status_code == 201, answer.text
    dora = Person(cloud, answer.json())
    assert [(each["id"], each["role"]) for each in dora.get("/devices").json()["items"]] == [(robot.device, "viewer")]
    assert sign_in(cloud, "dora d", GOOD).json()["account"]["id"] == dora.account
    problem(join(invitation, "emil"), 404, "invitation-unknown")
