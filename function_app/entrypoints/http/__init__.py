"""The HTTP API: FastAPI routes over the services, one file for each resource."""

from function_app.entrypoints.http.app import create_app

__all__ = ["create_app"]
