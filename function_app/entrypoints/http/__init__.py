"""The HTTP API: FastAPI routes, one module for each resource."""

from function_app.entrypoints.http.app import create_app

__all__ = ["create_app"]
