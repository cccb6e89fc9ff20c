"""Finds ONVIF cameras in the network and asks them for the addresses of their streams. All XML is hostile."""
