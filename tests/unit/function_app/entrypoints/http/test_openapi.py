"""The OpenAPI document is complete and consistent, and its HTML page needs no scripts."""

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


@pytest.fixture(scope="module")
def document(cloud: Cloud) -> dict[str, Any]:
    response = cloud.request("GET", "/api/v1/openapi.json")
    assert response.status_code == 200
    document: dict[str, Any] = response.json()
    return document


def operations(document: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, methods in document["paths"].items():
        assert set(methods) <= METHODS
        for method, operation in methods.items():
            yield method.upper(), path, operation


def test_every_reference_has_a_schema(document: dict[str, Any]) -> None:
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


def test_every_operation_is_complete(document: dict[str, Any]) -> None:
    assert document["openapi"].startswith("3.1")
    schemes = document["components"]["securitySchemes"].keys()
    names = []
    for method, path, operation in operations(document):
        where, responses = f"{method} {path}", operation["responses"]
        assert path.startswith("/api/v1/")
        names.append(operation["operationId"])
        assert all(operation[field] for field in ("summary", "description", "tags")), where
        assert any(status.startswith(("2", "3")) for status in responses), where
        for status, response in responses.items():
            assert response["description"], where
            if status.startswith("2"):
                assert "content" in response or status == "204", where
            elif status != "303":
                assert response["content"]["application/problem+json"]["schema"] == {"$ref": PROBLEM}, where
        accepted = {name for need in operation["security"] for name in need}
        assert accepted <= schemes, where
        assert not accepted or "401" in responses, where
        assert method == "GET" or "sessionCookie" not in accepted or "403" in responses, where
        described = {item["name"] for item in operation.get("parameters", []) if item["in"] == "path"}
        assert described == set(re.findall(r"{(\w+)}", path)), where
    assert len(names) == len(set(names)) > 100


def test_every_request_that_changes_something_declares_its_body(document: dict[str, Any]) -> None:
    for method, path, operation in operations(document):
        assert ("requestBody" in operation) is (method in {"POST", "PUT"}), f"{method} {path}"


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


def test_the_html_page_contains_every_route_and_no_external_links(cloud: Cloud, document: dict[str, Any]) -> None:
    response = cloud.request("GET", "/api/docs")
    assert response.status_code == 200
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    page = _Page()
    page.feed(response.text)
    assert page.open == []
    assert not page.tags & {"script", "style", "link", "img", "iframe", "form"}
    for link in page.links:
        assert link == "/api/v1/openapi.json" or link.removeprefix("#") in page.ids, link
    for method, path, operation in operations(document):
        assert f"{method} {path}" in response.text
        assert escape(operation["summary"]) in response.text


def test_the_html_page_escapes_text() -> None:
    evil = "<script>alert(1)</script>&'\""
    text = {"summary": evil, "description": evil}
    content = {"x": {"schema": {"$ref": f"#/components/schemas/{evil}"}}}
    operation = {
        **text,
        "security": [{evil: []}],
        "parameters": [{"name": evil, "in": evil}],
        "responses": {"200": {**text, "content": content}},
    }
    document = {
        "info": {**text, "title": evil, "version": evil},
        "paths": {f"/{evil}": {"get": operation}},
        "components": {"schemas": {evil: text}},
    }
    page_text = reference(document)
    assert "<script" not in page_text
    page = _Page()
    page.feed(page_text)
    assert page.open == []
