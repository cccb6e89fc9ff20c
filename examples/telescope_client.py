"""A minimal client for the examples: HTTP with a bearer token, and a broker connection.

Settings: ``TELESCOPE_URL`` (default http://127.0.0.1:8080) and ``TELESCOPE_TOKEN``, an access token or API key.
"""

import os
import sys
import uuid
from typing import Any

import paho.mqtt.client as mqtt
import requests

URL = os.environ.get("TELESCOPE_URL", "http://127.0.0.1:8080") + "/api/v1"


def call(method: str, path: str, body: dict[str, Any] | None = None) -> Any:
    """Call the API and return the parsed response. Exits with a text if it is rejected or not answered."""
    headers = {"Authorization": f"Bearer {os.environ['TELESCOPE_TOKEN']}"}
    if method == "POST":
        headers["Idempotency-Key"] = str(uuid.uuid4())
    try:
        response = requests.request(method, URL + path, json=body, headers=headers, timeout=60)
    except requests.RequestException:
        sys.exit(f"{method} {path}: no response from {URL}; check TELESCOPE_URL and the network")
    if not response.ok:
        sys.exit(f"{method} {path}: {response.status_code} {response.text}")
    return response.json() if response.content else None


def find_device(name: str) -> dict[str, Any]:
    """Return the first device with this name."""
    devices = call("GET", "/devices")["items"]
    for device in devices:
        if device["name"] == name:
            return dict(device)
    sys.exit(f"no device '{name}'; available: {', '.join(device['name'] for device in devices)}")


def connect_to_broker(request: dict[str, Any]) -> mqtt.Client:
    """Return a connected MQTT client with the rights of ``POST /mqtt/credentials``."""
    client, credentials = create_client(request)
    client.connect(credentials["tcp"]["host"], credentials["tcp"]["port"])
    return client


def create_client(request: dict[str, Any]) -> tuple[mqtt.Client, dict[str, Any]]:
    """Return an MQTT client that is not connected yet, and its credentials with ``lifetime_s`` and ``tcp``."""
    credentials = call("POST", "/mqtt/credentials", request)
    client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, client_id=credentials["client_id"], protocol=mqtt.MQTTv311)
    client.username_pw_set(credentials["username"], credentials["password"])
    if credentials["tcp"]["tls"]:
        client.tls_set()
    return client, credentials


def topic(device: dict[str, Any], suffix: str) -> str:
    """Return a topic of a device, such as ``tele/joints``."""
    return f"ts/v1/{device['space']}/{device['agent']}/{device['name']}/{suffix}"
