"""Factories of the accounts services."""

from functools import cached_property
from typing import Final

from function_app.adapters import factory
from function_app.bootstrap.sharing import SharingServices
from function_app.services.accounts.api_keys import ApiKeys
from function_app.services.accounts.oidc_sign_in import OidcSignIn
from function_app.services.accounts.passwords import Passwords
from function_app.services.accounts.sign_out import SignOut

OIDC_CALLBACK_PATH: Final = "/api/v1/auth/oidc/callback"
"""Path of the redirect URI that is registered at the OpenID Connect provider."""


class AccountServices(SharingServices):
    """Creates each accounts service on first use."""

    @cached_property
    def sign_out(self) -> SignOut:
        return SignOut(
            tables=self.tables,
            authenticator=self.authenticator,
            sessions=self.sessions,
            access=self.access,
            devices=self.devices,
            leases=self.leases,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def api_keys(self) -> ApiKeys:
        return ApiKeys(
            tables=self.tables,
            devices=self.devices,
            sign_in=self.sign_in,
            sign_out=self.sign_out,
            audit_log=self.audit_log,
            retention=self.retention,
            reminders=self.reminders,
            clock=self.clock,
        )

    @cached_property
    def oidc_sign_in(self) -> OidcSignIn:
        return OidcSignIn(
            tables=self.tables,
            provider=factory.oidc_provider(self.settings, self.clock),
            redirect=f"{self.settings.public_url}{OIDC_CALLBACK_PATH}",
            anyone=self.settings.oidc is not None and self.settings.oidc.anyone,
            sign_in=self.sign_in,
            sessions=self.sessions,
            invitations=self.invitations,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def passwords(self) -> Passwords:
        return Passwords(
            tables=self.tables,
            hasher=self.adapters.password_hashes,
            guess_limiter=self.guess_limiter,
            sign_in=self.sign_in,
            sessions=self.sessions,
            sign_out=self.sign_out,
            audit_log=self.audit_log,
            clock=self.clock,
        )
