"""Device lookup and permissions, spaces, labels and viewers."""
