"""HTTP polling transport and the client of the HTTP API."""
