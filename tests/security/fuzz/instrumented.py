"""Modules whose branches each target counts. Imports nothing, because the named modules are instrumented on import."""

_PROTOCOL = "device_agent.protocol"
_TARGETS = "tests.security.fuzz.targets"
MODULES: dict[str, list[str]] = {
    "messages": [f"{_PROTOCOL}.codec", _TARGETS],
    "signing": [f"{_PROTOCOL}.codec", f"{_PROTOCOL}.security.signing", "base64", _TARGETS],
    "topics": [f"{_PROTOCOL}.topics", f"{_PROTOCOL}.security.grants", _TARGETS],
    "robot_type": ["tomllib", f"{_PROTOCOL}.manifests.robot_type", _TARGETS],
    "grants": ["base64", "jwt", f"{_PROTOCOL}.security.grants", _TARGETS],
    "script": [f"{_PROTOCOL}.codec", "device_agent.ports.script_calls", _TARGETS],
    "http": ["device_agent.ports.clock", "device_agent.transports.http.client", _TARGETS],
    "stanzas": ["xml.etree.ElementTree", "base64", f"{_PROTOCOL}.xmpp.stanzas", _TARGETS],
    "home": [
        "tomllib",
        f"{_PROTOCOL}.security.signing",
        "device_agent.config.agent_config",
        "device_agent.config.identity_store",
        _TARGETS,
    ],
    "bodies": ["function_app.entrypoints.http.framework.responses", _TARGETS],
    "packets": ["amqtt.mqtt", "infra.embedded_broker.packets", _TARGETS],
}
