"""Headers of every response."""

from tests.security.tenants.test_routes import operations, send_request
from tests.security.tenants.world import World

HEADERS = {
    "content-security-policy",
    "x-content-type-options",
    "referrer-policy",
    "x-frame-options",
    "cross-origin-opener-policy",
    "cross-origin-resource-policy",
    "permissions-policy",
}


def test_every_response_has_the_security_headers(world: World) -> None:
    """For accepted and rejected requests; responses with secrets are not cached."""
    for name, method, path in operations(world):
        for caller in ("anonymous", "owner", "agent"):
            _, answer = send_request(world, caller, name, method, path)
            missing = HEADERS - set(answer.headers)
            assert not missing, f"{name} by {caller}: {missing}"
            assert answer.headers["x-content-type-options"] == "nosniff"
            assert "access-control-allow-origin" not in answer.headers
            assert "server" not in answer.headers
            if any(word in answer.text for word in ('"secret":"', '"access_token":"', '"token":"', '"password":"')):
                assert answer.headers.get("cache-control") == "no-store", f"{name} by {caller} may be cached"
            world.restore()
