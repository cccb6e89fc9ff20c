"""Operations that accept an API key. The OpenAPI document states it for each operation.

A new operation rejects API keys until it is added here. Listed operations check role, shares and the key's device
restriction like any other request.
"""

from typing import Final

FOR_KEYS: Final = frozenset(
    {
        "me",
        # Devices and their data.
        "list_devices",
        "get_device",
        "list_streams",
        "read_stream",
        "list_events",
        "device_sessions",
        "device_session",
        "get_autonomy",
        "list_faults",
        "get_diagnostics",
        "list_diagnostics",
        "get_latency",
        "add_latency",
        "list_uploads",
        "get_upload",
        "mqtt_credentials",
        # Control and actions. A person must inspect the device before the reset of a Stop.
        "get_lease",
        "take_lease",
        "release_lease",
        "request_control",
        "get_control_request",
        "accept_control_request",
        "reject_control_request",
        "withdraw_control_request",
        "start_action",
        "start_actions",
        "list_actions",
        "get_action",
        "cancel_action",
        "stop_device",
        "stop_space",
        "stop_all",
        # Robot types and movements, without scripts and models.
        "list_robot_types",
        "get_robot_type",
        "list_movements",
        "list_tasks",
        "get_task",
        "list_trials",
        "publish_trials",
        "get_device_robot_type",
        "list_device_movements",
    }
)
"""Operation ids of the OpenAPI document."""
