"""Connections to the software of robots and sensors, used by ``drivers`` and ``sensors``. They know no device."""
