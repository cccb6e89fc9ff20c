"""Actions and the queue of a device."""
