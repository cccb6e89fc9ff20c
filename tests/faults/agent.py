"""``device_agent run`` with another broker port and a configurable watchdog time."""

import sys
from typing import Any

import paho.mqtt.client as paho

from device_agent import __main__
from device_agent.runtime.control import setpoint_stream


def main(mqtt_port: str, watchdog_s: str, *arguments: str) -> int:
    connect = paho.Client.connect

    def redirected(client: paho.Client, host: str, _port: int, **options: Any) -> Any:
        return connect(client, host, int(mqtt_port), **options)

    paho.Client.connect = redirected  # type: ignore[method-assign,assignment]
    setpoint_stream.WATCHDOG_S = float(watchdog_s)
    return __main__.main(("run", *arguments))


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
