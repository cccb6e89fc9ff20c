"""What travels over HTTP, as structs: they read requests, write answers, and are the OpenAPI document's schemas.

One file for each file of routes. Requests refuse unknown fields and numbers that are not finite; ``*_at`` are RFC 3339
in UTC.
"""
