"""Factories of the identity services."""

from functools import cached_property

from function_app.bootstrap.audit import AuditServices
from function_app.services.identity.authenticator import Authenticator
from function_app.services.identity.guess_limiter import GuessLimiter
from function_app.services.identity.rate_limiter import RateLimiter
from function_app.services.identity.second_factor import SecondFactor
from function_app.services.identity.sessions import Sessions
from function_app.services.identity.sign_in import SignIn


class IdentityServices(AuditServices):
    """Creates each identity service on first use."""

    @cached_property
    def authenticator(self) -> Authenticator:
        return Authenticator(tables=self.tables, keys=self.keys, retention=self.retention, clock=self.clock)

    @cached_property
    def sessions(self) -> Sessions:
        return Sessions(
            tables=self.tables,
            authenticator=self.authenticator,
            retention=self.retention,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def second_factor(self) -> SecondFactor:
        return SecondFactor(
            tables=self.tables, guess_limiter=self.guess_limiter, audit_log=self.audit_log, clock=self.clock
        )

    @cached_property
    def sign_in(self) -> SignIn:
        return SignIn(
            tables=self.tables,
            sessions=self.sessions,
            second_factor=self.second_factor,
            audit_log=self.audit_log,
            clock=self.clock,
        )

    @cached_property
    def guess_limiter(self) -> GuessLimiter:
        return GuessLimiter(tables=self.tables, retention=self.retention, clock=self.clock)

    @cached_property
    def rate_limiter(self) -> RateLimiter:
        return RateLimiter(
            per_s={
                "address": self.settings.rate_limits.address,
                "account": self.settings.rate_limits.account,
                "key": self.settings.rate_limits.key,
                "agent": self.settings.rate_limits.agent,
            },
            clock=self.clock,
        )
