"""The API's description: whole, consistent, and readable without any script."""

import json
import re
from collections.abc import Iterator
from html import escape
from html.parser import HTMLParser
from typing import Any

import jsonschema
import pytest

from function_app.entrypoints.http.framework.api_reference import reference
from tests.harness.cloud.cloud import Cloud

METHODS = {"get", "post", "put", "delete"}
PROBLEM = "#/components/schemas/Problem"
BY_PROMISE = {
    "POST /auth/sign-in",
    "POST /auth/sign-out",
    "GET /accounts/me",
    "POST /agents/enroll",
    "GET /agents/enrollment",
    "POST /agents/claim",
    "GET /agents",
    "DELETE /agents/{agent}",
    "GET /devices",
    "GET /devices/{device}",
    "POST /devices/{device}/lease",
    "GET /devices/{device}/lease",
    "DELETE /devices/{device}/lease",
    "POST /devices/{device}/actions",
    "GET /devices/{device}/actions",
    "GET /actions/{action}",
    "POST /actions/{action}/cancel",
    "POST /devices/{device}/stop",
    "POST /devices/{device}/stop/reset",
    "POST /devices/{device}/lease/requests",
    "GET /devices/{device}/lease/requests/{request_id}",
    "DELETE /devices/{device}/lease/requests/{request_id}",
    "POST /devices/{device}/lease/requests/{request_id}/accept",
    "POST /devices/{device}/lease/requests/{request_id}/reject",
    "POST /spaces/{space}/stop",
    "POST /stop",
    "GET /robot-types",
    "GET /robot-types/{robot_type}",
    "GET /robot-types/{robot_type}/movements",
    "GET /robot-types/{robot_type}/movements/{name}",
    "PUT /robot-types/{robot_type}/movements/{name}",
    "DELETE /robot-types/{robot_type}/movements/{name}",
    "GET /robot-types/{robot_type}/scripting",
    "POST /robot-types/{robot_type}/scripting/check",
    "POST /mqtt/credentials",
    "GET /spaces",
    "GET /health",
}


@pytest.fixture(scope="module")
def document(cloud: Cloud) -> dict[str, Any]:
    answer = cloud.ask("GET", "/api/v1/openapi.json")
    assert answer.status_code == 200
    found: dict[str, Any] = answer.json()
    return found


def operations(document: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in document["paths"].items():
        assert set(methods) <= METHODS
        for method, operation in methods.items():
            yield method.upper(), path, operation


def test_it_describes_every_route_and_no_other(document: dict[str, Any]) -> None:
    assert document["openapi"].startswith("3.1")
    said = {f"{method} {path.removeprefix('/api/v1')}" for method, path, _ in operations(document)}
    assert said >= BY_PROMISE
    assert all(path.startswith("/api/v1/") for path in document["paths"])


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    text = json.dumps(document)
    names = set(re.findall(r'"\$ref": "([^"]+)"', text))
    assert names
    for name in names:
        assert name.startswith("#/components/schemas/"), name
        assert name.rpartition("/")[2] in document["components"]["schemas"], name
    assert "HTTPValidationError" not in text


def test_every_schema_is_a_json_schema(document: dict[str, Any]) -> None:
    for schema in document["components"]["schemas"].values():
        jsonschema.Draft202012Validator.check_schema(schema)


def test_every_operation_says_what_it_is_and_what_it_answers(document: dict[str, Any]) -> None:
    names = []
    for method, path, operation in operations(document):
        where = f"{method} {path}"
        names.append(operation["operationId"])
        assert operation["summary"], where
        assert operation["description"], where
        assert operation["tags"], where
        assert any(status.startswith(("2", "3")) for status in operation["responses"]), where
        for status, response in operation["responses"].items():
            assert response["description"], where
            if status.startswith("2"):
                assert "content" in response or status == "204", where
            elif status != "303":
                schema = response["content"]["application/problem+json"]["schema"]
                assert schema == {"$ref": PROBLEM}, where
    assert len(names) == len(set(names))


def test_every_operation_says_who_may_call_it(document: dict[str, Any]) -> None:
    schemes = document["components"]["securitySchemes"]
    open_to_all = []
    for _, path, operation in operations(document):
        for need in operation["security"]:
            assert set(need) <= set(schemes)
        if operation["security"]:
            assert "401" in operation["responses"]
        else:
            open_to_all.append(path)
    assert sorted(path.removeprefix("/api/v1") for path in open_to_all) == [
        "/auth/accounts",
        "/auth/methods",
        "/auth/oidc/callback",
        "/auth/oidc/start",
        "/auth/oidc/start",
        "/auth/password",
        "/auth/sign-in",
        "/health",
        "/xmpp/verify",
    ]


def test_what_changes_something_by_cookie_may_be_forbidden(document: dict[str, Any]) -> None:
    for method, path, operation in operations(document):
        if method != "GET" and {"sessionCookie": []} in operation["security"]:
            assert "403" in operation["responses"], path


def test_path_parameters_are_described(document: dict[str, Any]) -> None:
    for _, path, operation in operations(document):
        said = {item["name"] for item in operation.get("parameters", []) if item["in"] == "path"}
        assert said == set(re.findall(r"{(\w+)}", path))


def test_health_is_as_it_is_described(document: dict[str, Any], cloud: Cloud) -> None:
    schema = {**document["components"]["schemas"]["HealthOut"], "components": document["components"]}
    jsonschema.validate(cloud.ask("GET", "/api/v1/health").json(), schema)


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.ids: set[str] = set()
        self.links: set[str] = set()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag != "meta":
            self.open.append(tag)
        for name, value in attributes:
            assert name in {"lang", "charset", "name", "content", "id", "href"}, f"{tag} {name}"
            if name == "id":
                self.ids.add(value or "")
            if name == "href":
                self.links.add(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_for_people_names_every_route_and_links_only_to_itself(cloud: Cloud, document: dict[str, Any]) -> None:
    answer = cloud.ask("GET", "/api/docs")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    page = _Page()
    page.feed(answer.text)
    assert page.open == []
    assert not page.tags & {"script", "style", "link", "img", "iframe", "form"}
    for link in page.links:
        assert link == "/api/v1/openapi.json" or link.removeprefix("#") in page.ids, link
    for method, path, operation in operations(document):
        assert f"{method} {path}" in answer.text
        assert escape(operation["summary"]) in answer.text


def test_the_page_shows_hostile_text_as_text() -> None:
    evil = "<script>alert(1)</script>&'\""
    document: dict[str, Any] = {
        "info": {"title": evil, "version": evil, "description": evil},
        "paths": {
            f"/{evil}": {
                "get": {
                    "summary": evil,
                    "description": evil,
                    "security": [{evil: []}],
                    "parameters": [{"name": evil, "in": evil}],
                    "responses": {
                        "200": {
                            "description": evil,
                            "content": {"x": {"schema": {"$ref": f"#/components/schemas/{evil}"}}},
                        }
                    },
                }
            }
        },
        "components": {"schemas": {evil: {"description": evil}}},
    }
    text = reference(document)
    assert "<script" not in text
    page = _Page()
    page.feed(text)
    assert page.open == []
