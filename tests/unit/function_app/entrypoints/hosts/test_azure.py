"""The Azure Functions host: one app, four functions, and HTTP with the host's request types."""

import ast
import asyncio
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import azure.functions as func
import pytest

import function_app
from function_app.settings import ROOT


@pytest.fixture(scope="module")
def functions() -> dict[str, Any]:
    """The functions that the host indexes. The library allows only one call."""
    return {each.get_function_name(): each for each in function_app.app.get_functions()}


@pytest.fixture
def azure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    from function_app.entrypoints.hosts import azure

    monkeypatch.setenv("TELESCOPE_HOME", str(tmp_path))
    monkeypatch.setenv("TELESCOPE_MQTT_PORT", "1")
    azure._functions.cache_clear()
    azure._http.cache_clear()
    yield azure
    azure._functions.cache_clear()
    azure._http.cache_clear()


def test_the_package_exports_one_app_with_four_functions(functions: dict[str, Any]) -> None:
    assert not hasattr(function_app, "nothing")
    apps = [name for name in dir(function_app) if isinstance(getattr(function_app, name), func.FunctionApp)]
    assert apps == ["app"]
    assert set(functions) == {"admission", "http", "ingest", "sweep"}
    http, sweep = (json.loads(str(functions[name])) for name in ("http", "sweep"))
    trigger = next(each for each in http["bindings"] if each["type"] == "httpTrigger")
    assert (trigger["route"], trigger["authLevel"]) == ("{*path}", "ANONYMOUS")
    bindings = json.loads(str(functions["admission"]))["bindings"]
    admission = next(each for each in bindings if each["type"] == "httpTrigger")
    assert (admission["route"], admission["authLevel"]) == ("eventgrid/admission", "ANONYMOUS")
    assert {"GET", "POST", "PUT", "DELETE"} <= {str(method).rpartition(".")[2] for method in trigger["methods"]}
    (timer,) = [each for each in sweep["bindings"] if each["type"] == "timerTrigger"]
    assert timer["schedule"] == "*/5 * * * * *"
    (event,) = json.loads(str(functions["ingest"]))["bindings"]
    assert (event["type"], event["name"]) == ("eventGridTrigger", "event")


def test_azure_functions_is_imported_only_by_its_host() -> None:
    code = "import sys, function_app, function_app.bootstrap; sys.exit('azure.functions' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60, check=False).returncode == 0


def test_function_app_py_contains_only_a_docstring() -> None:
    module = ast.parse((ROOT / "function_app.py").read_text())
    assert ast.get_docstring(module)
    assert len(module.body) == 1
    host = json.loads((ROOT / "host.json").read_text())
    assert host["version"] == "2.0"
    assert host["extensions"]["http"]["routePrefix"] == ""
    local = json.loads((ROOT / "local.settings.json").read_text())
    assert local["Values"]["FUNCTIONS_WORKER_RUNTIME"] == "python"


def test_http_requests_of_the_host_reach_the_application(azure: Any, functions: dict[str, Any]) -> None:
    def request(method: str, path: str, body: bytes = b"", **headers: str) -> func.HttpRequest:
        return func.HttpRequest(
            method=method,
            url=f"http://localhost:7071{path}",
            headers=headers,
            params={},
            route_params={"path": path.removeprefix("/")},
            body=body,
        )

    async def send_requests() -> list[func.HttpResponse]:
        try:
            await called["sweep"](None)
            link = await azure._functions().sign_in.link(await azure._functions().sign_in.account("anna"))
            body = json.dumps({"link": link}).encode()
            return [
                await called["http"](request("GET", "/api/v1/health"), None),
                await called["http"](
                    request("POST", "/api/v1/auth/sign-in", body, **{"content-length": str(len(body))}), None
                ),
                await called["http"](request("GET", "/api/v1/devices", authorization="Bearer x"), None),
                await called["http"](request("GET", "/api/v1/nothing"), None),
                await called["admission"](request("POST", "/eventgrid/admission", b"{}")),
            ]
        finally:
            await azure._functions().close()

    called = {name: each.get_user_function() for name, each in functions.items()}
    health, signed_in, rejected, unknown, admission = asyncio.run(send_requests())
    assert health.status_code == 200
    assert json.loads(health.get_body())["tables"] == "ok"
    assert signed_in.status_code == 200
    assert json.loads(signed_in.get_body())["account"]["name"] == "anna"
    assert "telescope_session=" in signed_in.headers["set-cookie"]
    assert (rejected.status_code, unknown.status_code, admission.status_code) == (401, 404, 404)
    assert rejected.headers["content-type"] == "application/problem+json"
