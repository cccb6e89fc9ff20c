"""Publishes messages as a node of ROS 1, under the Python that has ``rospy``: ``rospy_sensors.py FILE``.

The file is a JSON object: topic → type and message, with binary data as Base64.
"""

import base64
import importlib
import json
import sys
from pathlib import Path

import genpy.message
import rospy


def main():
    rospy.init_node("sensors", disable_signals=True)
    publications = []
    for topic, (kind, values) in json.loads(Path(sys.argv[1]).read_text()).items():
        package, _, name = kind.partition("/")
        message = getattr(importlib.import_module(f"{package}.msg"), name)()
        data = values.pop("data", None)
        genpy.message.fill_message_args(message, [values])
        if data is not None:
            message.data = base64.b64decode(data)
        publications.append((rospy.Publisher(topic, type(message), queue_size=1), message))
    print("ready", flush=True)
    while True:
        for publisher, message in publications:
            if publisher.get_num_connections():
                publisher.publish(message)
        rospy.sleep(0.05)


if __name__ == "__main__":
    main()
