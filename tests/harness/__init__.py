"""Shared test infrastructure: broker and server processes, clients, emulated stores and browsers."""
