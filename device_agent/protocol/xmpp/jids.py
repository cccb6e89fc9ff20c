"""Well-known JIDs, in a module that loads no XML parser."""

CLOUD = "cloud"
"""User name of the cloud; each of its processes has a resource of its own."""
