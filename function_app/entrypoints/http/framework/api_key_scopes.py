"""What an API key may ask for: this list, and nothing that is not on it. The API's description says the same of each.

A route that is new is for people until somebody thinks about it and adds it here. What is on the list looks its device
up as anybody's request does, so role, shares and what the key is kept to hold there.
"""

from typing import Final

FOR_KEYS: Final = frozenset(
    {
        "me",
        # Devices, and what is known of them.
        "list_devices",
        "get_device",
        "list_streams",
        "read_stream",
        "list_events",
        "list_faults",
        "get_diagnostics",
        "list_diagnostics",
        "get_latency",
        "add_latency",
        "list_uploads",
        "get_upload",
        "mqtt_credentials",
        # Control and actions. Not the reset of a Stop: that is for who has seen that everybody is clear.
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
        # What can be asked of a robot; not anybody's scripts or models.
        "list_robot_types",
        "get_robot_type",
        "list_movements",
        "get_device_robot_type",
        "list_device_movements",
    }
)
"""Operations, by their names in the API's description."""
