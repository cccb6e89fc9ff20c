"""Certificates of a site: from its own name-constrained CA, or imported."""
