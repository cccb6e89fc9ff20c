"""The site broker: mosquitto with its dynamic security plugin, configured to refuse whatever was not granted.

``python -m infra.mosquitto --home DIR`` writes what it needs into DIR and runs it. Grants reach it through
``function_app.adapters.local.broker_access.MosquittoBrokerAccess``.
"""
