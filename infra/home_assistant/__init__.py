"""The optional bridge to Home Assistant: announces room devices by MQTT discovery, and carries what is said and set.

``python -m infra.home_assistant``; see the README beside this.
"""
