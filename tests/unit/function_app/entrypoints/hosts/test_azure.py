"""What a Functions host sees: one app, four functions, and HTTP through the host's own types."""

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
    """What the host indexes; the library refuses to be asked a second time."""
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


def test_a_host_finds_one_app_with_four_functions(functions: dict[str, Any]) -> None:
    assert not hasattr(function_app, "nothing")
    apps = [name for name in dir(function_app) if isinstance(getattr(function_app, name), func.FunctionApp)]
    assert apps == ["app"]
    assert set(functions) == {"admission", "http", "ingest", "sweep"}
    http, sweep = (json.loads(str(functions[name])) for name in ("http", "sweep"))
    trigger = next(each for each in http["bindings"] if each["type"] == "httpTrigger")
    assert (trigger["route"], trigger["authLevel"]) == ("{*path}", "ANONYMOUS")
    asked = json.loads(str(functions["admission"]))["bindings"]
    admission = next(each for each in asked if each["type"] == "httpTrigger")
    assert (admission["route"], admission["authLevel"]) == ("eventgrid/admission", "ANONYMOUS")
    assert {"GET", "POST", "PUT", "DELETE"} <= {str(method).rpartition(".")[2] for method in trigger["methods"]}
    (timer,) = [each for each in sweep["bindings"] if each["type"] == "timerTrigger"]
    assert timer["schedule"] == "*/5 * * * * *"
    (event,) = json.loads(str(functions["ingest"]))["bindings"]
    assert (event["type"], event["name"]) == ("eventGridTrigger", "event")


def test_only_a_host_pays_for_the_import() -> None:
    code = "import sys, function_app, function_app.bootstrap; sys.exit('azure.functions' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=60, check=False).returncode == 0


def test_the_file_that_a_host_looks_for_is_a_docstring_only() -> None:
    module = ast.parse((ROOT / "function_app.py").read_text())
    assert ast.get_docstring(module)
    assert len(module.body) == 1
    host = json.loads((ROOT / "host.json").read_text())
    assert host["version"] == "2.0"
    assert host["extensions"]["http"]["routePrefix"] == ""
    local = json.loads((ROOT / "local.settings.json").read_text())
    assert local["Values"]["FUNCTIONS_WORKER_RUNTIME"] == "python"


def test_http_passes_through_the_hosts_own_types(azure: Any, functions: dict[str, Any]) -> None:
    def ask(method: str, path: str, body: bytes = b"", **headers: str) -> func.HttpRequest:
        return func.HttpRequest(
            method=method,
            url=f"http://localhost:7071{path}",
            headers=headers,
            params={},
            route_params={"path": path.removeprefix("/")},
            body=body,
        )

    async def talk() -> list[func.HttpResponse]:
        try:
            await called["sweep"](None)
            link = await azure._functions().sign_in.link(await azure._functions().sign_in.account("anna"))
            body = json.dumps({"link": link}).encode()
            return [
                await called["http"](ask("GET", "/api/v1/health"), None),
                await called["http"](
                    ask("POST", "/api/v1/auth/sign-in", body, **{"content-length": str(len(body))}), None
                ),
                await called["http"](ask("GET", "/api/v1/devices", authorization="Bearer x"), None),
                await called["http"](ask("GET", "/api/v1/nothing"), None),
                await called["admission"](ask("POST", "/eventgrid/admission", b"{}")),
            ]
        finally:
            await azure._functions().close()

    called = {name: each.get_user_function() for name, each in functions.items()}
    health, signed_in, refused, nothing, admission = asyncio.run(talk())
    assert health.status_code == 200
    assert json.loads(health.get_body())["tables"] == "ok"
    assert signed_in.status_code == 200
    assert json.loads(signed_in.get_body())["account"]["name"] == "anna"
    assert "telescope_session=" in signed_in.headers["set-cookie"]
    assert (refused.status_code, nothing.status_code, admission.status_code) == (401, 404, 404)
    assert refused.headers["content-type"] == "application/problem+json"
