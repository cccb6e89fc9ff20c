"""The second factor of the signed-in account."""

from fastapi import Request, Response

from function_app.bootstrap import Functions
from function_app.domain.common.timestamps import rfc3339
from function_app.domain.identity.accounts import Identity
from function_app.entrypoints.http.accounts import schemas
from function_app.entrypoints.http.framework.authentication import RequestAuthenticator
from function_app.entrypoints.http.framework.responses import empty, json_response, read
from function_app.entrypoints.http.framework.routing import Routes
from function_app.services.identity.second_factor import change_counter

_PATH = "/accounts/me/second-factor"
_NO_STORE = {"Cache-Control": "no-store"}


def router(functions: Functions, auth: RequestAuthenticator) -> Routes:
    """The routes."""
    routes = Routes("accounts")

    @routes.add(f"GET {_PATH}", "Get the second factor", schemas.SecondFactorOut)
    async def get_second_factor(request: Request) -> Response:
        """Returns whether sign-in requires a code of an authenticator app."""
        caller = await auth.account(request)
        status = await functions.second_factor.status(caller.account)
        body = schemas.SecondFactorOut(
            enabled=bool(status.enabled_ms),
            enabled_at=rfc3339(status.enabled_ms) if status.enabled_ms else None,
            recovery_codes=status.recovery_codes,
        )
        return json_response(body)

    @routes.add(
        f"POST {_PATH}",
        "Add a second factor",
        {201: schemas.SecondFactorSecret},
        (409, 429),
        body=schemas.SecondFactorRequest,
    )
    async def add_second_factor(request: Request) -> Response:
        """Returns a new secret for an authenticator app (TOTP, RFC 6238). It has no effect until it is enabled."""
        caller = await auth.account(request)
        payload: schemas.SecondFactorRequest = await read(request, schemas.SecondFactorRequest)
        await functions.passwords.prove(caller, payload.password, auth.origin(request))
        secret, uri = await functions.second_factor.begin(caller)
        body = schemas.SecondFactorSecret(secret=secret, otpauth_uri=uri, qr=_qr_rows(uri))
        return json_response(body, 201, _NO_STORE)

    @routes.add(
        f"POST {_PATH}/enable", "Enable the second factor", schemas.RecoveryCodes, 404, body=schemas.SecondFactorCode
    )
    async def enable_second_factor(request: Request) -> Response:
        """Requires a code of the new secret. Ends all other sessions, because they began without the factor."""
        caller = await auth.account(request)
        payload: schemas.SecondFactorCode = await read(request, schemas.SecondFactorCode)
        codes = await functions.second_factor.enable(caller, payload.code)
        await functions.sign_out.others(caller)
        return json_response(schemas.RecoveryCodes(recovery_codes=codes), headers=_NO_STORE)

    @routes.add(
        f"POST {_PATH}/recovery-codes",
        "Renew the recovery codes",
        schemas.RecoveryCodes,
        404,
        body=schemas.SecondFactorCode,
    )
    async def renew_recovery_codes(request: Request) -> Response:
        """Requires a code. The previous recovery codes are not valid any more."""
        caller = await _confirmed(request)
        codes = await functions.second_factor.renew_recovery_codes(caller)
        return json_response(schemas.RecoveryCodes(recovery_codes=codes), headers=_NO_STORE)

    @routes.add(f"POST {_PATH}/disable", "Disable the second factor", None, 404, body=schemas.SecondFactorCode)
    async def disable_second_factor(request: Request) -> Response:
        """Requires a code."""
        await functions.second_factor.disable(await _confirmed(request))
        return empty()

    async def _confirmed(request: Request) -> Identity:
        caller = await auth.account(request)
        payload: schemas.SecondFactorCode = await read(request, schemas.SecondFactorCode)
        await functions.second_factor.check(
            caller.account, payload.code, auth.origin(request), counter=change_counter(caller)
        )
        return caller

    return routes


def _qr_rows(text: str) -> tuple[str, ...]:
    """The rows of a QR code. The console draws them itself, so that no other server receives the secret."""
    import segno  # noqa: PLC0415 (15 ms, which a cold start need not wait for)

    matrix = segno.make(text, micro=False, error="m").matrix
    return tuple("".join("1" if module & 1 else "0" for module in row) for row in matrix)
