"""Signing in by a one-time link, cookies, sign-out."""

from http.cookies import SimpleCookie

import httpx
import jwt
import pytest
from hypothesis import given
from hypothesis import settings as quickly
from hypothesis import strategies as st

from device_agent.protocol.security import signing
from tests.fixtures.cloud import OpenCloud
from tests.harness.cloud.cloud import API, Cloud, problem
from tests.harness.cloud.memory import Memory

SIGN_IN = f"{API}/auth/sign-in"


def sign_in(cloud: Cloud, link: str) -> httpx.Response:
    return cloud.request("POST", SIGN_IN, json={"link": link})


def test_a_link_signs_in_once(cloud: Cloud) -> None:
    link = cloud.link("anna")
    answer = sign_in(cloud, link)
    body = answer.json()
    assert (body["token_type"], body["expires_in_s"], body["account"]["name"]) == ("Bearer", 900, "anna")
    assert answer.headers["cache-control"] == "no-store"
    problem(sign_in(cloud, link), 401, "unauthorized")


def test_a_link_is_valid_for_a_day_and_only_its_hash_is_stored(cloud: Cloud, memory: Memory) -> None:
    early, late = cloud.link("anna"), cloud.link("anna")
    assert memory.tables.rows("SignIns")
    assert early not in str(memory.tables.rows())
    cloud.clock.advance(24 * 3600 - 60)
    assert sign_in(cloud, early).status_code == 200
    cloud.clock.advance(60)
    problem(sign_in(cloud, late), 401, "unauthorized")
    for invalid in ("x", "", "A" * 43, "🤖", "x" * 201):
        assert sign_in(cloud, invalid).status_code in {401, 422}


def test_the_same_name_is_the_same_account_with_one_space(cloud: Cloud) -> None:
    one, two = cloud.sign_in("anna"), cloud.sign_in("anna")
    assert one.account == two.account
    assert one.session != two.session
    me = {"id": one.account, "name": "anna", "session": one.session, "csrf_token": None, "administrator": False}
    storage = {"device_limit_bytes": 10_000_000_000, "devices": {}, "limit_bytes": 20_000_000_000, "used_bytes": 0}
    assert one.get("/accounts/me").json() == {**me, "storage": storage}
    (space,) = one.get("/spaces").json()["items"]
    owner = {"id": one.account, "name": "anna"}
    assert space == {"id": space["id"], "name": "Home", "role": "owner", "owner": owner}
    assert two.get("/spaces").json()["items"] == [space]
    (other,) = cloud.sign_in("bert").get("/spaces").json()["items"]
    assert other["id"] != space["id"]


class TestCookie:
    @pytest.fixture
    def page(self, cloud: Cloud) -> httpx.AsyncClient:
        """A browser that has signed in."""
        client = cloud.client()
        answer = cloud.run(client.post(SIGN_IN, json={"link": cloud.link("anna")}))
        cookie = SimpleCookie(answer.headers["set-cookie"])["telescope_session"]
        assert (cookie["path"], cookie["samesite"], cookie["max-age"]) == ("/api", "Strict", "43200")
        assert cookie["httponly"] is True
        assert cookie["secure"] == ""
        return client

    def test_changes_require_the_csrf_token_of_the_session(self, cloud: Cloud, page: httpx.AsyncClient) -> None:
        me = cloud.run(page.get(f"{API}/accounts/me")).json()
        assert me["name"] == "anna"
        other = cloud.run(cloud.client().post(SIGN_IN, json={"link": cloud.link("anna")})).json()["csrf_token"]
        for method, path, body in (
            ("POST", "/auth/sign-out", None),
            ("POST", "/agents/claim", {"code": "BCDF-GHJK"}),
            ("PUT", "/robot-types/ur5/movements/mine", {"source": "1"}),
            ("DELETE", "/agents/abcdefgh23", None),
            ("POST", "/mqtt/credentials", {"purpose": "view"}),
            ("POST", "/devices/abcdefgh23-arm/stop", None),
        ):
            for wrong in ("", "x", "ü", other, me["csrf_token"] + "x", me["csrf_token"][:-1]):
                headers = [(b"X-CSRF-Token", wrong.encode())] if wrong else []
                problem(cloud.run(page.request(method, API + path, json=body, headers=headers)), 403, "csrf-token")
        shown = {"X-CSRF-Token": me["csrf_token"]}
        answer = cloud.run(page.put(f"{API}/robot-types/ur5/movements/mine", json={"source": "1"}, headers=shown))
        assert answer.status_code == 201

    def test_sign_out_clears_it_and_ends_the_session(self, cloud: Cloud, page: httpx.AsyncClient) -> None:
        stolen = dict(page.cookies)
        token = cloud.run(page.get(f"{API}/accounts/me")).json()["csrf_token"]
        answer = cloud.run(page.post(f"{API}/auth/sign-out", headers={"X-CSRF-Token": token}))
        assert answer.status_code == 204
        assert dict(page.cookies) == {}
        problem(cloud.run(page.get(f"{API}/accounts/me")), 401, "unauthorized")
        thief = cloud.client(cookies=stolen)
        problem(cloud.run(thief.get(f"{API}/accounts/me")), 401, "unauthorized")

    def test_cookies_and_access_tokens_are_not_interchangeable(self, cloud: Cloud, page: httpx.AsyncClient) -> None:
        cookie = page.cookies["telescope_session"]
        answer = cloud.request("GET", f"{API}/accounts/me", headers={"Authorization": f"Bearer {cookie}"})
        problem(answer, 401, "unauthorized")
        client = cloud.client(cookies={"telescope_session": cloud.sign_in("anna").token})
        problem(cloud.run(client.get(f"{API}/accounts/me")), 401, "unauthorized")
        me = cloud.run(page.get(f"{API}/accounts/me")).json()
        problem(cloud.run(page.post(f"{API}/auth/token")), 403, "csrf-token")
        answer = cloud.run(page.post(f"{API}/auth/token", headers={"X-CSRF-Token": me["csrf_token"]}))
        headers = {"Authorization": f"Bearer {answer.json()['access_token']}"}
        assert cloud.request("GET", f"{API}/accounts/me", headers=headers).json()["session"] == me["session"]
        problem(cloud.request("POST", f"{API}/auth/token", headers=headers), 401, "unauthorized")

    @pytest.mark.parametrize("site", ["cross-site", "same-site"])
    def test_a_cross_site_request_cannot_sign_in(self, cloud: Cloud, site: str) -> None:
        link = cloud.link("mallory")
        headers = {"Sec-Fetch-Site": site}
        problem(cloud.request("POST", SIGN_IN, json={"link": link}, headers=headers), 403, "forbidden")
        body = {"name": "mallory", "password": "does not matter"}
        problem(cloud.request("POST", f"{API}/auth/password", json=body, headers=headers), 403, "forbidden")
        assert cloud.request("POST", SIGN_IN, json={"link": link}, headers={"Sec-Fetch-Site": "same-origin"}).is_success

    def test_over_https_it_is_secure(self, open_cloud: OpenCloud) -> None:
        cloud = open_cloud(public_url="https://telescope.example")
        assert "; Secure" in sign_in(cloud, cloud.link("anna")).headers["set-cookie"]


class TestAccessToken:
    def test_it_expires_after_15_minutes(self, cloud: Cloud) -> None:
        def request(token: str) -> httpx.Response:
            return cloud.request("GET", f"{API}/accounts/me", headers={"Authorization": f"Bearer {token}"})

        used, unused = cloud.sign_in("anna").token, cloud.sign_in("anna").token
        assert request(used).status_code == 200
        cloud.clock.advance(890)
        assert request(used).status_code == 200
        cloud.clock.advance(20)
        for token in (used, unused):
            problem(request(token), 401, "unauthorized")
        assert request(cloud.sign_in("anna").token).status_code == 200

    def test_sign_out_ends_only_this_session_in_every_instance(self, open_cloud: OpenCloud) -> None:
        local, remote = open_cloud(), open_cloud()
        ended, other = local.sign_in("anna"), local.sign_in("anna")
        headers = {"Authorization": f"Bearer {ended.token}"}
        assert remote.request("GET", f"{API}/accounts/me", headers=headers).status_code == 200
        assert ended.post("/auth/sign-out").status_code == 204
        problem(ended.get("/accounts/me"), 401, "unauthorized")
        local.clock.advance(5)
        problem(remote.request("GET", f"{API}/accounts/me", headers=headers), 401, "unauthorized")
        assert other.get("/accounts/me").status_code == 200

    def test_forged_tokens_are_refused(self, cloud: Cloud) -> None:
        anna = cloud.sign_in("anna")
        claims = jwt.decode(anna.token, options={"verify_signature": False})
        kid = jwt.get_unverified_header(anna.token)["kid"]
        evil = signing.generate()
        head, body, tail = anna.token.split(".")
        for token in (
            jwt.encode(claims, evil, "EdDSA", headers={"kid": kid}),
            jwt.encode(claims, evil, "EdDSA", headers={"kid": signing.key_id(evil.public_key())}),
            jwt.encode(claims, "x" * 32, "HS256", headers={"kid": kid}),
            jwt.encode(claims, "", "none", headers={"kid": kid}),
            f"{head}.{body}.",
            f"{head}.{body}.{tail[:-4]}AAAA",
            f"{head}.{body[:-4]}AAAA.{tail}",
        ):
            answer = cloud.request("GET", f"{API}/accounts/me", headers={"Authorization": f"Bearer {token}"})
            problem(answer, 401, "unauthorized")
            assert answer.headers["www-authenticate"] == "Bearer"

    def test_any_text_is_refused(self, cloud: Cloud) -> None:
        @quickly(max_examples=80)
        @given(st.text(alphabet=st.characters(min_codepoint=33, max_codepoint=255), max_size=60))
        def check(text: str) -> None:
            for path in ("/accounts/me", "/agents/enrollment"):
                header = f"Bearer {text}".encode("latin-1")
                problem(cloud.request("GET", API + path, headers={b"Authorization": header}), 401, "unauthorized")

        check()
