"""The measurements of the two papers, repeated with Telescope."""
