"""Routes of devices and viewers."""
