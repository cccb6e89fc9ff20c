"""Peers of the drivers of room devices: a broker of a house with simulated devices, Modbus servers, serial lines."""
