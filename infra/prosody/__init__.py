"""The site's XMPP server: Prosody, which authenticates against the functions and only permits traffic with the cloud.

``python -m infra.prosody --home DIR --domain NAME --verify-url URL`` writes its files into DIR and runs it.
"""
