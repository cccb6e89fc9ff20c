"""The API reference as one page of plain HTML, without scripts, style sheets or external resources."""

import json
from html import escape
from typing import Any


def reference(document: dict[str, Any]) -> str:
    """The HTML page for an OpenAPI document."""
    info = document["info"]
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width'>",
        f"<title>{escape(info['title'])} API</title></head><body><main>",
        f"<h1>{escape(info['title'])} API {escape(info['version'])}</h1><p>{escape(info['description'])}</p>",
        "<p>For programs: <a href='/api/v1/openapi.json'>OpenAPI</a>. Errors are problem details (RFC 9457).</p>",
    ]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            parts += _operation(method, path, operation)
    parts.append("<h2>Schemas</h2>")
    for name, schema in sorted(document["components"]["schemas"].items()):
        text = escape(json.dumps(schema, indent=1, ensure_ascii=False))
        parts.append(f"<details id='{escape(name)}'><summary>{escape(name)}</summary><pre>{text}</pre></details>")
    parts.append("</main></body></html>")
    return "\n".join(parts)


def _operation(method: str, path: str, operation: dict[str, Any]) -> list[str]:
    parts = [
        f"<h2><code>{method.upper()} {escape(path)}</code></h2>",
        f"<p><b>{escape(operation.get('summary', ''))}.</b> {escape(operation.get('description', ''))}</p>",
    ]
    caller = " or ".join(name for scheme in operation.get("security", []) for name in scheme)
    parts.append(f"<p>Caller: {escape(caller) or 'anyone'}</p>")
    parameters = [
        f"<code>{escape(item['name'])}</code> ({escape(item['in'])})" for item in operation.get("parameters", [])
    ]
    if parameters:
        parts.append(f"<p>Parameters: {', '.join(parameters)}</p>")
    if "requestBody" in operation:
        parts.append(f"<p>Body: {_schema(operation['requestBody']['content'])}</p>")
    parts.append("<ul>")
    for status, response in operation["responses"].items():
        parts.append(f"<li>{status} {escape(response['description'])}: {_schema(response.get('content', {}))}</li>")
    parts.append("</ul>")
    return parts


def _schema(content: dict[str, Any]) -> str:
    links = []
    for kind, media in content.items():
        schema = media["schema"]
        if schema.get("format") == "binary":
            links.append(escape(kind))
            continue
        for each in schema.get("anyOf", [schema]):
            name = str(each.get("$ref", "")).rpartition("/")[2]
            links.append(f"<a href='#{escape(name)}'>{escape(name)}</a>")
    return " or ".join(links) or "no body"
