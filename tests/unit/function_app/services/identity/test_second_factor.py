"""The second factor of local accounts: TOTP and recovery codes."""

from typing import Any

import httpx
import pyotp
import pytest

from tests.harness.cloud.cloud import API, Cloud, Person, problem

PASSWORD = "correct horse battery"  # pragma: allowlist secret
FACTOR = "/accounts/me/second-factor"


class App:
    """An authenticator app with the secret of an account."""

    def __init__(self, cloud: Cloud, secret: str) -> None:
        self._cloud = cloud
        self._totp = pyotp.TOTP(secret)

    def code(self) -> str:
        """A new code: the next time step begins first."""
        self._cloud.clock.advance(30)
        return self._totp.at(self._cloud.clock.now_ms() // 1000)


def enrolled(cloud: Cloud, person: Person) -> tuple[App, list[str]]:
    added = person.post(FACTOR, {"password": PASSWORD})
    assert added.status_code == 201, added.text
    app = App(cloud, added.json()["secret"])
    enabled = person.post(f"{FACTOR}/enable", {"code": app.code()})
    assert enabled.status_code == 200, enabled.text
    return app, enabled.json()["recovery_codes"]


@pytest.fixture
def anna(cloud: Cloud) -> Person:
    """A person with a password."""
    anna = cloud.sign_in("anna")
    assert anna.put("/accounts/me/password", {"password": PASSWORD}).status_code == 204
    return anna


def sign_in(cloud: Cloud, code: str = "", password: str = PASSWORD, **more: Any) -> httpx.Response:
    body = {"name": "anna", "password": password, "code": code, **more}
    return cloud.request("POST", f"{API}/auth/password", json=body)


def test_sign_in_requires_a_code_after_enrolment(cloud: Cloud, anna: Person) -> None:
    app, _ = enrolled(cloud, anna)
    problem(sign_in(cloud, password="wrong"), 401, "unauthorized")
    problem(sign_in(cloud), 403, "second-factor-required")
    problem(sign_in(cloud, "000000"), 403, "second-factor-wrong")
    code = app.code()
    assert sign_in(cloud, f"{code[:3]} {code[3:]}").status_code == 200
    link = cloud.link("anna")
    for body, code_of_problem in (({}, "second-factor-required"), ({"code": "000000"}, "second-factor-wrong")):
        answer = cloud.request("POST", f"{API}/auth/sign-in", json={"link": link, **body})
        problem(answer, 403, code_of_problem)
    answer = cloud.request("POST", f"{API}/auth/sign-in", json={"link": link, "code": app.code()})
    assert answer.status_code == 200, "wrong codes do not use up the link"
    used = [
        each["data"].get("second_factor") for each in anna.get("/accounts/me/audit?event=signed-in").json()["items"]
    ]
    assert used == ["totp", "totp", ""]


def test_a_code_is_valid_once(cloud: Cloud, anna: Person) -> None:
    app, recovery = enrolled(cloud, anna)
    for code in (app.code(), recovery[0], recovery[1].replace("-", "").upper()):
        assert sign_in(cloud, code).status_code == 200
        problem(sign_in(cloud, code), 403, "second-factor-wrong")
    assert anna.get(FACTOR).json()["recovery_codes"] == len(recovery) - 2
    early = app.code()
    newer = app.code()
    assert sign_in(cloud, newer).status_code == 200
    problem(sign_in(cloud, early), 403, "second-factor-wrong")


def test_ten_wrong_codes_block_unknown_browsers_only(cloud: Cloud, anna: Person) -> None:
    app, _ = enrolled(cloud, anna)
    known = sign_in(cloud, app.code()).json()["device_token"]
    for _ in range(10):
        problem(sign_in(cloud, "000000"), 403, "second-factor-wrong")
    problem(sign_in(cloud, app.code()), 429, "too-many-tries")
    assert sign_in(cloud, app.code(), device_token=known).status_code == 200
    rejected = anna.get("/accounts/me/audit?event=sign-in-rejected").json()["items"]
    assert [each["data"]["code"] for each in rejected] == ["too-many-tries", *["second-factor-wrong"] * 10]


def test_enrolment_requires_the_password_and_ends_other_sessions(cloud: Cloud, anna: Person) -> None:
    other = cloud.sign_in("anna")
    cloud.clock.advance(601)
    problem(anna.post(FACTOR, {}), 403, "forbidden")
    problem(anna.post(FACTOR, {"password": "wrong"}), 403, "forbidden")
    problem(anna.post(f"{FACTOR}/enable", {"code": "123456"}), 404, "second-factor-unknown")
    added = anna.post(FACTOR, {"password": PASSWORD}).json()
    assert added["otpauth_uri"].startswith("otpauth://totp/Telescope:anna?secret=")
    assert len(added["qr"]) == len(added["qr"][0])
    problem(anna.post(f"{FACTOR}/enable", {"code": "000000"}), 403, "second-factor-wrong")
    assert sign_in(cloud).status_code == 200, "no effect before it is enabled"
    assert other.get("/accounts/me").status_code == 200
    enrolled(cloud, anna)
    problem(other.get("/accounts/me"), 401, "unauthorized")
    problem(anna.post(FACTOR, {"password": PASSWORD}), 409, "second-factor-enabled")


def test_a_code_confirms_changes(cloud: Cloud, anna: Person) -> None:
    app, recovery = enrolled(cloud, anna)
    for change in ("recovery-codes", "disable"):
        problem(anna.post(f"{FACTOR}/{change}", {"code": "000000"}), 403, "second-factor-wrong")
    renewed = anna.post(f"{FACTOR}/recovery-codes", {"code": app.code()}).json()["recovery_codes"]
    problem(sign_in(cloud, recovery[0]), 403, "second-factor-wrong")
    assert anna.post(f"{FACTOR}/disable", {"code": renewed[0]}).status_code == 204
    assert anna.get(FACTOR).json() == {"enabled": False, "enabled_at": None, "recovery_codes": 0}
    assert sign_in(cloud).status_code == 200
    problem(anna.post(f"{FACTOR}/disable", {"code": app.code()}), 404, "second-factor-unknown")
    events = [each["event"] for each in anna.get("/accounts/me/audit").json()["items"]]
    changes = [event for event in events if event.startswith(("second-factor", "recovery"))]
    assert changes == ["second-factor-disabled", "recovery-codes-made", "second-factor-enabled"]


def test_the_operator_of_the_server_removes_a_lost_factor(cloud: Cloud, anna: Person) -> None:
    enrolled(cloud, anna)
    account = cloud.run(cloud.functions.sign_in.account("anna"))
    cloud.run(cloud.functions.second_factor.remove(account))
    assert cloud.sign_in("anna").get(FACTOR).json()["enabled"] is False


def test_concurrent_sign_ins_with_one_code_succeed_once(cloud: Cloud, anna: Person) -> None:
    app, _ = enrolled(cloud, anna)
    client, body = cloud.client(), {"name": "anna", "password": PASSWORD, "code": app.code()}
    calls = [cloud.begin(client.post(f"{API}/auth/password", json=body)) for _ in range(4)]
    assert sorted(call().status_code for call in calls) == [200, 403, 403, 403]
