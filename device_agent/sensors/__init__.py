"""Room sensors, one folder each. None yet: they come with the intelligent space."""
