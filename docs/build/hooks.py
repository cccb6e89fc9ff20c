"""MkDocs hooks: generate the API pages and copy browser code, so that the site loads nothing from other hosts."""

import json
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from function_app import bootstrap, settings
from function_app.entrypoints.http.app import create_app

DOCS = Path(__file__).resolve().parents[1]
PACKAGES = Path(__file__).resolve().parent / "node_modules"
ASSETS = {
    "assets/mermaid.js": PACKAGES / "@mermaid-js" / "tiny" / "dist" / "mermaid.tiny.js",
    "assets/swagger-ui.js": PACKAGES / "swagger-ui-dist" / "swagger-ui-bundle.js",
    "assets/swagger-ui.css": PACKAGES / "swagger-ui-dist" / "swagger-ui.css",
}
_API_PAGE = """# Interactive API reference

Generated from the OpenAPI document ([openapi.json](openapi.json)). A running installation serves its own
version at `/api/docs`. [HTTP API](http-api.md) describes the conventions.

<link rel="stylesheet" href="../assets/swagger-ui.css">
<div id="swagger-ui"></div>
<script src="../assets/openapi.js"></script>
<script src="../assets/swagger-ui.js"></script>
<script>
SwaggerUIBundle({
  spec: openapi, dom_id: "#swagger-ui", filter: true, docExpansion: "none",
  supportedSubmitMethods: [], validatorUrl: null
});
</script>
"""


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add all decision pages to the navigation."""
    pages = sorted(path.name for path in (DOCS / "decisions").glob("[0-9]*.md"))
    assert config.nav is not None
    config.nav.append({"Decisions": ["decisions/index.md", *(f"decisions/{name}" for name in pages)]})
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the generated pages and the bundled browser code."""
    openapi = json.dumps(openapi_document())
    generated = {
        "reference/openapi.md": _API_PAGE,
        "reference/openapi.json": openapi,
        "assets/openapi.js": f"const openapi = {openapi};",
        "reference/messages.md": messages_page(json.loads((DOCS / "asyncapi.json").read_text(encoding="utf-8"))),
    }
    for name, content in generated.items():
        files.append(File.generated(config, name, content=content))
    for name, path in ASSETS.items():
        files.append(File.generated(config, name, abs_src_path=str(path)))
    return files


def openapi_document() -> dict[str, Any]:
    """Return the OpenAPI document of the HTTP API."""
    with tempfile.TemporaryDirectory() as home:
        return create_app(bootstrap.build(settings.read({"TELESCOPE_HOME": home}))).openapi()


def messages_page(document: Mapping[str, Any]) -> str:
    """Return the AsyncAPI document as a Markdown page: topics, then messages with their fields."""
    return "\n".join(_messages(document)) + "\n"


def _messages(document: Mapping[str, Any]) -> Iterator[str]:
    yield "# Messages\n"
    yield f"{document['info']['description']}\n"
    yield "Generated from the AsyncAPI document ([asyncapi.json](../asyncapi.json)).\n"
    yield "## Topics\n"
    yield "| topic | QoS | retained | message | purpose |\n| --- | --- | --- | --- | --- |"
    for operation in document["operations"].values():
        channel = document["channels"][_name(operation["channel"])]
        mqtt = operation.get("bindings", {}).get("mqtt", {})
        kinds = ", ".join(_reference(name, document["components"]["schemas"]) for name in channel["messages"])
        retained = "yes" if mqtt.get("retain") else "no"
        purpose = _cell(operation["summary"])
        yield f"| `{channel['address']}` | {mqtt.get('qos', '')} | {retained} | {kinds} | {purpose} |"
    yield "\n## Types\n"
    schemas = document["components"]["schemas"]
    for name, schema in schemas.items():
        yield f"### {name}\n"
        yield f"{_prose(schema.get('description', ''))}\n"
        if values := schema.get("enum"):
            yield ", ".join(f"`{value}`" for value in values) + "\n"
        if properties := schema.get("properties"):
            required = schema.get("required", ())
            yield "| field | type | required | limits |\n| --- | --- | --- | --- |"
            for field, kind in properties.items():
                needed = "yes" if field in required else "no"
                yield f"| `{field}` | {_type(kind, schemas)} | {needed} | {_limits(kind)} |"
            yield ""


def _name(reference: Mapping[str, str]) -> str:
    return reference["$ref"].rpartition("/")[2]


def _reference(name: str, schemas: Mapping[str, Any]) -> str:
    return f"[{name}](#{name.lower()})" if name in schemas else f"`{name}`"


def _type(kind: Mapping[str, Any], schemas: Mapping[str, Any]) -> str:
    if "$ref" in kind:
        return _reference(_name(kind), schemas)
    if options := kind.get("anyOf") or kind.get("oneOf"):
        return " or ".join(_type(option, schemas) for option in options)
    if "const" in kind or "enum" in kind:
        return " or ".join(f"`{value}`" for value in kind.get("enum", [kind.get("const")]))
    if kind.get("type") == "array":
        return f"list of {_type(kind['items'], schemas)}" if isinstance(kind.get("items"), dict) else "list"
    if kind.get("type") == "object":
        values = kind.get("additionalProperties")
        return f"map to {_type(values, schemas)}" if isinstance(values, dict) and values else "object"
    return str(kind.get("type", "any"))


def _limits(kind: Mapping[str, Any]) -> str:
    words = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<", "maxLength": "length ≤",
             "maxItems": "items ≤", "pattern": "matches", "default": "default"}  # fmt: skip
    return _cell(", ".join(f"{word} `{json.dumps(kind[key])}`" for key, word in words.items() if key in kind))


def _prose(text: str) -> str:
    """Return a docstring without indentation and with its sections as paragraphs."""
    return re.sub(r"\n\s+", "\n", text.replace("``", "`"))


def _cell(text: str) -> str:
    return _prose(text).replace("|", "\\|").replace("\n", " ")
