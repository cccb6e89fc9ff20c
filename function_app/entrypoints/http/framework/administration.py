"""Which callers may read the state of the installation."""

import hmac
import ipaddress
from enum import IntEnum

from fastapi import Request

from function_app.domain.common.problems import Problem, forbidden
from function_app.domain.identity.accounts import Identity, fold_name
from function_app.entrypoints.http.framework.authentication import COOKIE, RequestAuthenticator, bearer
from function_app.ports.tables import StoreError
from function_app.settings import Administration


class Access(IntEnum):
    """What a caller may read of the server's state."""

    STATUS = 0
    """The overall status: callers without sign-in."""
    TEXTS = 1
    """Also texts of the parts that concern users: signed-in accounts."""
    DETAILS = 2
    """Everything: administrators, and a monitoring system with the metrics token."""


def is_administrator(caller: Identity, administration: Administration) -> bool:
    """Whether the caller is a person whose account the settings name."""
    return not caller.key and fold_name(caller.name) in administration.accounts


async def access_of(request: Request, auth: RequestAuthenticator, administration: Administration) -> Access:
    """The access of a caller; invalid credentials count as none."""
    if has_metrics_token(request, administration):
        return Access.DETAILS
    if not bearer(request) and COOKIE not in request.cookies:
        return Access.STATUS
    try:
        caller = await auth.account(request)
    except (Problem, StoreError):
        return Access.STATUS
    return Access.DETAILS if is_administrator(caller, administration) else Access.TEXTS


async def require_administrator(request: Request, auth: RequestAuthenticator, administration: Administration) -> None:
    """Reject callers that are not administrators.

    Raises:
        Problem: ``unauthorized``, ``forbidden``.
    """
    if not is_administrator(await auth.account(request), administration):
        raise forbidden("Only administrators of this server may do this. TELESCOPE_ADMINISTRATORS names them.")


def has_metrics_token(request: Request, administration: Administration) -> bool:
    """Whether the request has the metrics token."""
    token = administration.metrics_token
    return bool(token) and hmac.compare_digest(bearer(request).encode(), token.encode())


def is_local(request: Request) -> bool:
    """Whether the request comes from a program on this machine, without a proxy."""
    if request.client is None or "x-forwarded-for" in request.headers:
        return False
    try:
        return ipaddress.ip_address(request.client.host).is_loopback
    except ValueError:
        return False
