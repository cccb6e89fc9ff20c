"""Certificates of a site, by one command: an own authority for its names alone, or certificates from elsewhere."""
