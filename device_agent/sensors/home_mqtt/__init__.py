"""Devices at the MQTT broker of a house: Tasmota and Zigbee2MQTT. It is not the broker of Telescope."""
