"""The wire contract between operator, cloud and agent: topics, messages, signatures, broker grants.

The only package that both sides import. It depends on ``msgspec``, ``cryptography`` and ``pyjwt`` and on nothing of
ours. ``docs/asyncapi.json`` and ``web/src/core/protocol.ts`` are generated from it (``make contract``).
"""
