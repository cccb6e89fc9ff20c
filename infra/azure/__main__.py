"""``python -m infra.azure``: print the configuration of an Event Grid namespace as an ARM template.

``az deployment group create --resource-group GROUP --template-file FILE --parameters namespace=NAME functions=ID``
deploys it into an existing namespace and may be repeated. It contains the client groups, topic spaces and permission
bindings of ``function_app.adapters.azure.topic_spaces``, and the functions' right to publish to their own topic space.
Other resources of the namespace stay unchanged: they must not grant ``$all`` any access.

API version and role: Microsoft, "Microsoft.EventGrid namespaces" (ARM templates) and "Azure built-in roles".
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from function_app.adapters.azure import topic_spaces
from function_app.adapters.azure.topic_spaces import FUNCTIONS_SPACE

API_VERSION = "2025-02-15"
PUBLISHER_ROLE = "a12b0b94-b317-4dcd-84a8-502ce99884c6"
"""``EventGrid TopicSpaces Publisher``."""
_SCHEMA = "https://schema.management.azure.com/schemas/2019-04-01/deploymentTemplate.json#"
_NAMESPACE = "Microsoft.EventGrid/namespaces"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print or write the template; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m infra.azure", description="Topic spaces, client groups and permission bindings for Event Grid."
    )
    parser.add_argument("file", type=Path, nargs="?", help="output file (default: standard output)")
    options = parser.parse_args(arguments)
    text = json.dumps(template(), indent=2) + "\n"
    if options.file is None:
        print(text, end="")
        return 0
    try:
        options.file.write_text(text, encoding="utf-8")
    except OSError as error:
        print(f"telescope: cannot write {options.file}: {error.strerror}", file=sys.stderr)
        return 1
    return 0


def template() -> dict[str, Any]:
    """The ARM template."""
    resources = [_child("clientGroups", name, {"query": query}) for name, query in topic_spaces.groups().items()]
    resources += [
        _child("topicSpaces", name, {"topicTemplates": templates}) for name, templates in topic_spaces.spaces().items()
    ]
    for group, space, permission in topic_spaces.bindings():
        bound = {"clientGroupName": group, "topicSpaceName": space, "permission": permission}
        after = [_id("clientGroups", group), _id("topicSpaces", space)]
        resources.append(_child("permissionBindings", space, bound, after))
    return {
        "$schema": _SCHEMA,
        "contentVersion": "1.0.0.0",
        "parameters": {
            "namespace": {"type": "string", "metadata": {"description": "Name of the Event Grid namespace"}},
            "functions": {"type": "string", "metadata": {"description": "Principal id of the functions' identity"}},
        },
        "resources": [*resources, _role()],
    }


def _role() -> dict[str, Any]:
    where = f"{_NAMESPACE}/topicSpaces/{FUNCTIONS_SPACE}"
    role = f"subscriptionResourceId('Microsoft.Authorization/roleDefinitions', '{PUBLISHER_ROLE}')"
    return {
        "type": "Microsoft.Authorization/roleAssignments",
        "apiVersion": "2022-04-01",
        "name": f"[guid(parameters('namespace'), parameters('functions'), '{where}')]",
        "scope": f"[format('{_NAMESPACE}/{{0}}/topicSpaces/{FUNCTIONS_SPACE}', parameters('namespace'))]",
        "dependsOn": [_id("topicSpaces", FUNCTIONS_SPACE)],
        "properties": {
            "roleDefinitionId": f"[{role}]",
            "principalId": "[parameters('functions')]",
            "principalType": "ServicePrincipal",
        },
    }


def _child(kind: str, name: str, properties: dict[str, Any], after: Sequence[str] = ()) -> dict[str, Any]:
    return {
        "type": f"{_NAMESPACE}/{kind}",
        "apiVersion": API_VERSION,
        "name": f"[format('{{0}}/{name}', parameters('namespace'))]",
        "dependsOn": list(after),
        "properties": properties,
    }


def _id(kind: str, name: str) -> str:
    return f"[resourceId('{_NAMESPACE}/{kind}', parameters('namespace'), '{name}')]"


if __name__ == "__main__":
    sys.exit(main())
