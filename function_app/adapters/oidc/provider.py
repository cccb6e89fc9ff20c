"""An OpenID Connect provider over HTTP: discovery, the code flow, and validation of ID tokens.

Implements OpenID Connect Core 1.0 (sections 3.1.2 and 3.1.3), Discovery 1.0 and RFC 9207. It follows no redirects, and
sends requests only to URLs in the provider's metadata.
"""

import base64
import hmac
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote, urlencode, urlsplit

import jwt
import msgspec

from function_app.ports.clock import Clock
from function_app.ports.oidc_provider import OidcError, Subject

if TYPE_CHECKING:
    import httpx

ALGORITHMS: Final = frozenset(
    {"RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA"}
)
"""Asymmetric signatures: unsigned tokens and shared secrets do not prove the issuer."""
CACHE_MS: Final = 3_600_000
"""Cache lifetime of the provider's metadata and keys."""
MIN_REFRESH_MS: Final = 10_000
"""Minimum time between two fetches of the keys due to an unknown key id."""
SKEW_S: Final = 30
TIMEOUT_S: Final = 10.0
MAX_BYTES: Final = 262_144
_MAX_NAME: Final = 100
_MAX_SUBJECT: Final = 255
"""Maximum length of ``sub`` (OpenID Connect Core 1.0, section 2)."""
_OK: Final = 200
_LOOPBACK: Final = frozenset({"127.0.0.1", "::1", "localhost"})
_ENDPOINTS: Final = ("authorization_endpoint", "token_endpoint", "jwks_uri")


class HttpOidcProvider:
    """``OidcProvider`` of one issuer, with discovery below its URL. Without a secret this is a public client."""

    def __init__(self, *, issuer: str, client_id: str, client_secret: str, clock: Clock) -> None:
        self._issuer = issuer
        self._client_id = client_id
        self._client_secret = client_secret
        self._clock = clock
        self._metadata: dict[str, Any] = {}
        self._metadata_ms = -CACHE_MS
        self._keys: list[dict[str, Any]] = []
        self._keys_ms = -CACHE_MS

    async def address(self, *, state: str, nonce: str, challenge: str, redirect: str) -> str:
        endpoint = str((await self._provider())["authorization_endpoint"])
        parameters = {
            "response_type": "code",
            "client_id": self._client_id,
            "redirect_uri": redirect,
            "scope": "openid profile",
            "state": state,
            "nonce": nonce,
            "code_challenge": challenge,
            "code_challenge_method": "S256",
        }
        return f"{endpoint}{'&' if urlsplit(endpoint).query else '?'}{urlencode(parameters)}"

    async def redeem(self, *, code: str, verifier: str, nonce: str, redirect: str, issuer: str | None) -> Subject:
        provider = await self._provider()
        requires_issuer = provider.get("authorization_response_iss_parameter_supported") is True
        if issuer != self._issuer and (issuer is not None or requires_issuer):
            raise OidcError(f"the response is from {(issuer or '')[:200]!r}, not from {self._issuer}")
        form = {"grant_type": "authorization_code", "code": code, "redirect_uri": redirect, "code_verifier": verifier}
        headers: dict[str, str] = {}
        methods = provider.get("token_endpoint_auth_methods_supported") or ["client_secret_basic"]
        if not self._client_secret:
            form["client_id"] = self._client_id
        elif "client_secret_basic" in methods:
            headers["Authorization"] = _basic(self._client_id, self._client_secret)
        else:
            form |= {"client_id": self._client_id, "client_secret": self._client_secret}
        response = await self._fetch("POST", str(provider["token_endpoint"]), data=form, headers=headers)
        token = response.get("id_token")
        if not isinstance(token, str):
            raise OidcError("the provider's response contains no ID token")
        return self._subject(await self._verified(token), nonce)

    def _subject(self, claims: Mapping[str, Any], nonce: str) -> Subject:
        """The subject of a token whose signature is verified."""
        claim = claims.get("nonce")
        if not isinstance(claim, str) or not hmac.compare_digest(claim.encode(), nonce.encode()):
            raise OidcError("the ID token is from another sign-in: its nonce differs")
        if isinstance(claims["aud"], list) and len(claims["aud"]) > 1 and claims.get("azp") != self._client_id:
            raise OidcError("the ID token was issued to another client (azp)")
        now_s = self._clock.now_ms() / 1000
        times = [claims["exp"], claims["iat"], claims.get("nbf", 0)]
        if not all(isinstance(each, int | float) and math.isfinite(each) for each in times):
            raise OidcError("the times in the ID token are not numbers")
        if times[0] <= now_s - SKEW_S:
            raise OidcError("the ID token has expired")
        if max(times[1:]) > now_s + SKEW_S:
            raise OidcError("the ID token is from the future; set this machine's clock")
        subject = claims["sub"]
        if not isinstance(subject, str) or not 0 < len(subject) <= _MAX_SUBJECT:
            raise OidcError("the ID token has no valid subject (sub)")
        return Subject(self._issuer, subject, _name(claims) or subject[:_MAX_NAME])

    async def _verified(self, token: str) -> dict[str, Any]:
        try:
            header = jwt.get_unverified_header(token)
            algorithm = str(header.get("alg"))
            if algorithm not in ALGORITHMS:
                raise OidcError(f"the ID token is signed with {algorithm[:20]!r}, which is not accepted")
            key = await self._key(header.get("kid"), algorithm)
            claims: dict[str, Any] = jwt.decode(
                token,
                key,
                algorithms=[algorithm],
                audience=self._client_id,
                issuer=self._issuer,
                options={
                    "require": ["iss", "sub", "aud", "exp", "iat"],
                    "verify_exp": False,  # checked later by the injected clock
                    "verify_iat": False,
                    "verify_nbf": False,
                },
            )
        except jwt.PyJWTError as error:
            raise OidcError(f"the ID token is invalid: {error}") from error
        return claims

    async def _key(self, kid: object, algorithm: str) -> Any:
        """The provider's key with this id. An unknown id causes one fetch of the key set."""
        age_ms = self._clock.now_ms() - self._keys_ms
        key = self._select(kid, algorithm) if 0 <= age_ms < CACHE_MS else None
        if key is None and not 0 <= age_ms < MIN_REFRESH_MS:
            fetched = await self._fetch("GET", str((await self._provider())["jwks_uri"]))
            keys = fetched.get("keys")
            if not isinstance(keys, list):
                raise OidcError("the provider's key set contains no list of keys")
            self._keys = [each for each in keys if isinstance(each, dict)]
            self._keys_ms = self._clock.now_ms()
            key = self._select(kid, algorithm)
        if key is None:
            raise OidcError("the ID token is signed with a key that the provider does not publish")
        return key

    def _select(self, kid: object, algorithm: str) -> Any:
        matching = [
            key
            for key in self._keys
            if (kid is None or key.get("kid") == kid)
            and key.get("use", "sig") == "sig"
            and key.get("alg", algorithm) == algorithm
        ]
        # Without a key id, exactly one key must match.
        if len(matching) != 1:
            return None
        try:
            return jwt.PyJWK(matching[0], algorithm).key
        except (ValueError, TypeError, KeyError) as error:
            raise OidcError(f"a key of the provider cannot be read: {error!r}") from error

    async def _provider(self) -> dict[str, Any]:
        """The provider's metadata."""
        if not 0 <= self._clock.now_ms() - self._metadata_ms < CACHE_MS:
            metadata = await self._fetch("GET", f"{self._issuer.rstrip('/')}/.well-known/openid-configuration")
            if metadata.get("issuer") != self._issuer:
                issuer = str(metadata.get("issuer"))[:200]
                raise OidcError(f"the provider's issuer is {issuer!r}; set TELESCOPE_OIDC_ISSUER to this value")
            for name in _ENDPOINTS:
                if not _is_safe(metadata.get(name)):
                    raise OidcError(f"the provider's {name} is not an https URL")
            if "S256" not in (metadata.get("code_challenge_methods_supported") or ["S256"]):
                raise OidcError("the provider does not support PKCE with S256")
            self._metadata, self._metadata_ms = metadata, self._clock.now_ms()
        return self._metadata

    async def _fetch(
        self,
        method: str,
        address: str,
        *,
        data: Mapping[str, str] | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> dict[str, Any]:
        import httpx  # noqa: PLC0415 (only where it is in use)

        all_headers = {"Accept": "application/json", **(headers or {})}
        try:
            # A new client per call: sign-ins are rare, and a host may freeze between them.
            async with (
                httpx.AsyncClient(timeout=TIMEOUT_S, follow_redirects=False) as client,
                client.stream(method, address, data=data, headers=all_headers) as response,
            ):
                body = await _read(response, address)
        except httpx.HTTPError as error:
            raise OidcError(f"{address} cannot be used: {error or type(error).__name__}") from error
        if response.status_code != _OK:
            raise OidcError(f"{address} returned {response.status_code}: {body[:300].decode(errors='replace')!r}")
        try:
            content = msgspec.json.decode(body)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise OidcError(f"{address} did not return JSON: {error}") from error
        if not isinstance(content, dict):
            raise OidcError(f"{address} did not return a JSON object")
        return content


async def _read(response: "httpx.Response", address: str) -> bytes:
    parts = b""
    async for part in response.aiter_bytes():
        parts += part
        if len(parts) > MAX_BYTES:
            raise OidcError(f"{address} returned more than {MAX_BYTES} bytes")
    return parts


def _basic(client_id: str, secret: str) -> str:
    """The basic authentication header (RFC 6749, section 2.3.1); each part is form-encoded."""
    pair = f"{quote(client_id, safe='')}:{quote(secret, safe='')}"
    return f"Basic {base64.b64encode(pair.encode()).decode()}"


def _is_safe(address: object) -> bool:
    """Whether secrets may be sent to this URL: over TLS, or to this machine."""
    if not isinstance(address, str):
        return False
    parts = urlsplit(address)
    return bool(parts.hostname) and (
        parts.scheme == "https" or (parts.scheme == "http" and parts.hostname in _LOOPBACK)
    )


def _name(claims: Mapping[str, Any]) -> str:
    """The person's name in the token, without unprintable characters; empty if there is none."""
    for claim in ("name", "preferred_username", "email"):
        text = claims.get(claim)
        if isinstance(text, str):
            name = "".join(letter for letter in text if letter.isprintable()).strip()[:_MAX_NAME]
            if name:
                return name
    return ""
