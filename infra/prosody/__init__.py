"""The site's XMPP server: Prosody, which asks the functions who may log in and lets nobody speak but with the cloud.

``python -m infra.prosody --home DIR --domain NAME --verify-url URL`` writes what it needs into DIR and runs it.
"""
