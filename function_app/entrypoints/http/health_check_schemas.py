"""``health``."""

from typing import Literal

from function_app.entrypoints.http.framework.schemas import Response


class HealthOut(Response, frozen=True, kw_only=True):
    """``ok``, or a sentence, for each thing the functions need."""

    status: Literal["ok", "degraded"]
    version: str
    tables: str
    broker: str
