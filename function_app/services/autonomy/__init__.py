"""Sessions and autonomy of devices."""
