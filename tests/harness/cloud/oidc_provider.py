"""OpenID Connect providers for tests: a real one from npm, and one with configurable false responses.

with start_provider([new_key()]) as provider: ...
"""

import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Timer
from typing import Any

import httpx
import jwt
from cryptography.hazmat.primitives.asymmetric import rsa

FOLDER = Path(__file__).resolve().parents[1] / "identity_provider"
CLIENT_ID, CLIENT_SECRET = "telescope", "a secret of + and % and 32 letters"
REDIRECT = "http://telescope.test/api/v1/auth/oidc/callback"
START_WITHIN_S = 60
_LISTENS = re.compile(r"listening at (http://127\.0\.0\.1:(\d+))\n")
_ACTION = re.compile(r'action="([^"]+)"')
_FIELD = re.compile(r'name="(\w+)" value="(\w*)"')


@dataclass(frozen=True, slots=True)
class SigningKey:
    """A provider's key: private, and as it shows itself."""

    name: str
    private: rsa.RSAPrivateKey

    def shown(self, *, private: bool = False) -> dict[str, Any]:
        """As a JWK."""
        key = self.private if private else self.private.public_key()
        return {**jwt.algorithms.RSAAlgorithm.to_jwk(key, as_dict=True), "kid": self.name, "alg": "RS256", "use": "sig"}


def new_key(name: str = "one") -> SigningKey:
    """A new key."""
    return SigningKey(name, rsa.generate_private_key(65537, 2048))


@contextlib.contextmanager
def start_provider(keys: Sequence[SigningKey], port: int = 0, *, redirect: str = REDIRECT) -> Iterator[str]:
    """``oidc-provider`` with one client, us; gives its address. What it has given out it forgets with its end."""
    program = FOLDER / "node_modules" / "oidc-provider"
    assert program.exists(), f"oidc-provider is not installed; run `npm ci --prefix {FOLDER}`, as `make test` does"
    places = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    node = shutil.which("node", path=places)
    assert node, "Node.js is not installed; `make test` installs it"
    client = {"client_id": CLIENT_ID, "client_secret": CLIENT_SECRET, "redirect_uris": [redirect]}
    wanted = {"port": port, "client": client, "keys": [key.shown(private=True) for key in keys]}
    with subprocess.Popen(
        [node, str(FOLDER / "server.mjs")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        patience = Timer(START_WITHIN_S, process.kill)
        patience.start()
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(json.dumps(wanted) + "\n")
        process.stdin.flush()
        said = ""
        try:
            found = None
            while found is None:
                line = process.stdout.readline()
                assert line, f"the provider did not start: {said}"
                said += line
                found = _LISTENS.match(line)
        finally:
            patience.cancel()
            patience.join()
        try:
            yield found[1]
        finally:
            process.communicate(timeout=START_WITHIN_S)  # closes its standard input, which ends it


def sign_in_there(address: str, name: str, browser: httpx.Client | None = None) -> httpx.URL:
    """Follow the provider's redirects and fill in its forms; where the browser is sent back to."""
    with contextlib.ExitStack() as stack:
        client = browser or stack.enter_context(httpx.Client())
        answer = client.get(address)
        for _ in range(12):
            if answer.is_redirect:
                place = answer.url.join(answer.headers["location"])
                if place.host == httpx.URL(REDIRECT).host:
                    return place
                answer = client.get(place)
                continue
            assert answer.status_code == httpx.codes.OK, answer.text
            action = _ACTION.search(answer.text)
            assert action is not None, answer.text
            fields = dict(_FIELD.findall(answer.text))
            if fields.get("prompt") == "login":
                fields |= {"login": name, "password": "any"}
            answer = client.post(answer.url.join(action[1]), data=fields)
    raise AssertionError("the provider sends one from form to form")


@dataclass
class Liar:
    """What the lying provider says: each may be changed at any time.

    Attributes:
        document: About itself; set by the server.
        keys: Shown.
        token: What stands for an ID token.
        status: Of the token endpoint's answer.
        asked: Forms that it was sent.
    """

    document: dict[str, Any] = field(default_factory=dict)
    keys: list[Any] = field(default_factory=list)
    token: Any = None
    status: int = 200
    asked: list[str] = field(default_factory=list)
    fetched: list[str] = field(default_factory=list)
    issuer: str = ""


@contextlib.contextmanager
def start_liar() -> Iterator[Liar]:
    """A provider that returns the configured documents and keys."""
    liar = Liar()

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            liar.fetched.append(self.path)
            self._say(liar.document if self.path.startswith("/.well-known/") else {"keys": liar.keys}, 200)

        def do_POST(self) -> None:
            liar.asked.append(self.rfile.read(int(self.headers["Content-Length"])).decode())
            self._say({"access_token": "x", "token_type": "Bearer", "id_token": liar.token}, liar.status)

        def _say(self, what: Any, status: int) -> None:
            body = json.dumps(what).encode()
            self.send_response_only(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Answer) as server:
        liar.issuer = f"http://127.0.0.1:{server.server_port}"
        liar.document = {
            "issuer": liar.issuer,
            "authorization_endpoint": f"{liar.issuer}/authorize",
            "token_endpoint": f"{liar.issuer}/token",
            "jwks_uri": f"{liar.issuer}/keys",
        }
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield liar
        finally:
            server.shutdown()
            thread.join()
