"""Sign-in with a real OpenID Connect provider, and attacks on the redirect."""

import contextlib
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest

from function_app.domain.audit.hash_chain import CLOUD
from function_app.services.storage import records
from function_app.settings import OidcClient
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import API, BASE, Cloud, Person, problem, settings
from tests.harness.cloud.oidc_provider import (
    CLIENT_ID,
    CLIENT_SECRET,
    REDIRECT,
    SigningKey,
    new_key,
    sign_in_at_provider,
    start_provider,
)

START, CALLBACK = f"{API}/auth/oidc/start", f"{API}/auth/oidc/callback"


@pytest.fixture(scope="module")
def provider(key: SigningKey) -> Iterator[str]:
    with start_provider([key]) as address:
        yield address


def opened(home: Path, issuer: str, *, anyone: bool = True) -> Cloud:
    client = OidcClient(
        issuer=issuer, client_id=CLIENT_ID, client_secret=CLIENT_SECRET, name="The lab's", anyone=anyone
    )
    return Cloud(replace(settings(home), public_url=BASE, oidc=client), clock=MovingClock())


@pytest.fixture
def cloud_with_oidc(home: Path, provider: str) -> Iterator[Cloud]:
    """Functions with sign-in at the real provider."""
    with opened(home, provider) as cloud:
        yield cloud


@pytest.fixture
def closed(home: Path, provider: str) -> Iterator[Cloud]:
    """Functions in which new accounts require an invitation."""
    with opened(home, provider, anyone=False) as cloud:
        yield cloud


class Browser:
    """A browser with cookies of the console and of the provider."""

    def __init__(self, cloud: Cloud) -> None:
        self.cloud = cloud
        self.page = cloud.client()

    def start(self) -> str:
        answer = self.cloud.run(self.page.get(START))
        assert answer.status_code == 303, answer.text
        assert answer.headers["cache-control"] == "no-store"
        return answer.headers["location"]

    def start_with(self, invitation: str) -> str:
        answer = self.cloud.run(self.page.post(START, json={"invitation": invitation}))
        assert answer.status_code == 200, answer.text
        assert answer.headers["cache-control"] == "no-store"
        assert invitation not in answer.text + str(answer.headers)
        return str(answer.json()["url"])

    def back(self, callback: httpx.URL) -> httpx.Response:
        return self.cloud.run(self.page.get(callback.raw_path.decode()))

    def sign_in(self, name: str) -> httpx.Response:
        return self.back(sign_in_at_provider(self.start(), name))

    def me(self) -> httpx.Response:
        return self.cloud.run(self.page.get(f"{API}/accounts/me"))


def failed(answer: httpx.Response, reason: str) -> None:
    """Assert a redirect to the page with this reason, without a session."""
    assert (answer.status_code, answer.headers["location"]) == (303, f"{BASE}/#sign-in-failed=oidc-{reason}")
    assert "set-cookie" not in answer.headers


def test_repeated_sign_in_returns_the_same_account(cloud_with_oidc: Cloud) -> None:
    local = cloud_with_oidc.sign_in("Name of anna")
    browser, again, other = Browser(cloud_with_oidc), Browser(cloud_with_oidc), Browser(cloud_with_oidc)
    answer = browser.sign_in("anna")
    assert (answer.status_code, answer.headers["location"]) == (303, f"{BASE}/#/")
    assert "HttpOnly; SameSite=Strict" in answer.headers["set-cookie"]
    me = browser.me().json()
    assert me["name"] == "Name of anna"
    assert me["id"] != local.account, "an equal name is not the same account"
    assert me["csrf_token"]
    assert len(cloud_with_oidc.run(browser.page.get(f"{API}/spaces")).json()["items"]) == 1
    (session,) = cloud_with_oidc.run(browser.page.get(f"{API}/accounts/me/sessions")).json()["items"]
    assert (session["method"], session["mine"]) == ("oidc", True)
    again.sign_in("anna")
    assert again.me().json()["id"] == me["id"]
    other.sign_in("bert")
    assert other.me().json()["id"] not in {me["id"], local.account}
    headers = {"X-CSRF-Token": me["csrf_token"]}
    body = {"password": "correct horse battery"}
    problem(
        cloud_with_oidc.run(browser.page.put(f"{API}/accounts/me/password", json=body, headers=headers)),
        409,
        "password-not-managed-here",
    )


class TestNewAccounts:
    """The provider also authenticates users without an invitation."""

    @staticmethod
    def invite(owner: Person, **more: Any) -> str:
        space = owner.get("/spaces").json()["items"][0]["id"]
        answer = owner.post(f"/spaces/{space}/invitations", {"role": "viewer", **more})
        assert answer.status_code == 201, answer.text
        return str(answer.json()["secret"])

    @staticmethod
    def accounts(cloud: Cloud) -> set[str]:
        with sqlite3.connect(cloud.functions.settings.home / "tables.sqlite") as tables:
            return {row for (row,) in tables.execute("SELECT part FROM rows WHERE tab = ?", (records.ACCOUNTS,))}

    def test_an_uninvited_user_gets_no_account_and_leaves_no_data(self, closed: Cloud) -> None:
        closed.sign_in("anna")
        before = self.accounts(closed)
        browser = Browser(closed)
        failed(browser.sign_in("mallory"), "uninvited")
        assert browser.me().status_code == 401
        assert self.accounts(closed) == before
        refused = closed.run(closed.functions.tables.query(records.AUDIT, CLOUD, first="record:", last="record;")).rows
        assert "oidc-uninvited" in {row.data["data"].get("code") for row in refused}

    def test_an_invited_user_gets_an_account_with_the_offered_role_and_signs_in_again(self, closed: Cloud) -> None:
        owner = closed.sign_in("anna")
        secret = self.invite(owner)
        browser = Browser(closed)
        answer = browser.back(sign_in_at_provider(browser.start_with(secret), "bert"))
        assert answer.headers["location"] == f"{BASE}/#/"
        me = browser.me().json()
        assert me["name"] == "Name of bert"
        roles = {each["role"] for each in closed.run(browser.page.get(f"{API}/spaces")).json()["items"]}
        assert roles == {"owner", "viewer"}
        again = Browser(closed)
        again.sign_in("bert")
        assert again.me().json()["id"] == me["id"]
        # The invitation is valid for one use.
        other = Browser(closed)
        problem(closed.run(other.page.post(START, json={"invitation": secret})), 404, "invitation-unknown")
        failed(other.sign_in("mallory"), "uninvited")

    @pytest.mark.parametrize(("limits", "later_s"), [({"expires_in_s": 300}, 301), ({"account": "carl"}, 0)])
    def test_an_invitation_that_expires_meanwhile_or_is_for_another_account_admits_no_user(
        self, closed: Cloud, limits: dict[str, Any], later_s: float
    ) -> None:
        owner, _ = closed.sign_in("anna"), closed.sign_in("carl")
        browser = Browser(closed)
        callback = sign_in_at_provider(browser.start_with(self.invite(owner, **limits)), "bert")
        closed.clock.advance(later_s)
        failed(browser.back(callback), "uninvited")

    def test_a_page_of_another_site_cannot_start_a_sign_in_with_an_invitation(self, closed: Cloud) -> None:
        secret = self.invite(closed.sign_in("anna"))
        headers = {"Sec-Fetch-Site": "cross-site"}
        problem(closed.request("POST", START, json={"invitation": secret}, headers=headers), 403, "forbidden")

    def test_without_required_invitations_a_new_user_gets_an_empty_account(self, cloud_with_oidc: Cloud) -> None:
        browser = Browser(cloud_with_oidc)
        assert browser.sign_in("stranger").headers["location"] == f"{BASE}/#/"
        assert cloud_with_oidc.run(browser.page.get(f"{API}/devices")).json()["items"] == []


def test_the_redirect_contains_state_nonce_and_pkce_challenge(cloud_with_oidc: Cloud, provider: str) -> None:
    answer = cloud_with_oidc.request("GET", START)
    query = {name: value for name, (value,) in parse_qs(urlsplit(answer.headers["location"]).query).items()}
    assert answer.headers["location"].startswith(f"{provider}/auth?")
    assert (query["response_type"], query["code_challenge_method"], query["redirect_uri"]) == ("code", "S256", REDIRECT)
    assert len({query["state"], query["nonce"], query["code_challenge"]}) == 3
    cookie = answer.headers["set-cookie"]
    assert "Path=/api/v1/auth/oidc; Max-Age=600; HttpOnly; SameSite=Lax" in cookie
    assert query["state"] not in cookie


def test_the_api_lists_the_sign_in_methods(cloud_with_oidc: Cloud, cloud: Cloud) -> None:
    elsewhere = {"name": "The lab's", "url": START}
    assert cloud_with_oidc.request("GET", f"{API}/auth/methods").json() == {
        "link": True,
        "password": True,
        "oidc": elsewhere,
    }
    assert cloud.request("GET", f"{API}/auth/methods").json() == {"link": True, "password": True, "oidc": None}
    for path in (START, f"{CALLBACK}?code=x&state=y"):
        problem(cloud.request("GET", path), 404, "oidc-unknown")


def test_a_callback_is_valid_once_and_only_in_the_same_browser(cloud_with_oidc: Cloud) -> None:
    anna, mallory = Browser(cloud_with_oidc), Browser(cloud_with_oidc)
    callback = sign_in_at_provider(anna.start(), "anna")
    failed(mallory.back(callback), "expired")
    mallory.start()
    failed(mallory.back(callback), "expired")
    assert anna.back(callback).headers["location"] == f"{BASE}/#/"
    failed(anna.back(callback), "expired")
    assert anna.me().status_code == 200


def test_a_code_of_another_sign_in_is_rejected(cloud_with_oidc: Cloud) -> None:
    """The PKCE verifier does not match, so the provider rejects the code."""
    anna, mallory = Browser(cloud_with_oidc), Browser(cloud_with_oidc)
    first = sign_in_at_provider(anna.start(), "anna")
    stolen = sign_in_at_provider(mallory.start(), "mallory").copy_set_param("code", first.params["code"])
    failed(mallory.back(stolen), "rejected")
    assert mallory.me().status_code == 401
    anna.back(first)
    used = sign_in_at_provider(anna.start(), "anna").copy_set_param("code", first.params["code"])
    failed(anna.back(used), "rejected")


@pytest.mark.parametrize(
    ("change", "later_s", "reason"),
    [
        (lambda url: url.copy_set_param("iss", "https://evil.example"), 0, "rejected"),
        (lambda url: url.copy_remove_param("iss"), 0, "rejected"),
        (lambda url: httpx.URL(f"{REDIRECT}?error=access_denied&state={url.params['state']}"), 0, "rejected"),
        (lambda url: url.copy_set_param("state", "x" * 43), 0, "expired"),
        (lambda url: url.copy_remove_param("state"), 0, "expired"),
        (lambda url: url, 601, "expired"),
    ],
    ids=["another issuer", "no issuer", "refused", "another state", "no state", "late"],
)
def test_an_invalid_callback_is_rejected(
    cloud_with_oidc: Cloud, change: Callable[[httpx.URL], httpx.URL], later_s: float, reason: str
) -> None:
    browser = Browser(cloud_with_oidc)
    callback = sign_in_at_provider(browser.start(), "anna")
    cloud_with_oidc.clock.advance(later_s)
    failed(browser.back(change(callback)), reason)
    assert browser.me().status_code == 401


def test_new_keys_of_a_provider_are_accepted(home: Path, key: SigningKey) -> None:
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(contextlib.ExitStack())
        issuer = first.enter_context(start_provider([key]))
        cloud = stack.enter_context(opened(home, issuer))
        Browser(cloud).sign_in("anna")
        first.close()
        failed_start = cloud.request("GET", START)
        assert failed_start.status_code == 303, "the provider's discovery document must be cached"
        stack.enter_context(start_provider([new_key("two"), key], port=urlsplit(issuer).port or 0))
        cloud.clock.advance(11)
        browser = Browser(cloud)
        assert browser.sign_in("anna").headers["location"] == f"{BASE}/#/"
        assert browser.me().status_code == 200


def test_an_unreachable_provider_is_reported_as_unavailable(home: Path) -> None:
    with opened(home, "http://127.0.0.1:1") as cloud:
        answer = cloud.request("GET", START)
        problem(answer, 503, "oidc-unavailable")
        assert answer.headers["retry-after"] == "30"
