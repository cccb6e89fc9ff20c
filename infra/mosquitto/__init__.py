"""The site broker: mosquitto with its dynamic security plugin, denying by default, behind HAProxy.

``python -m infra.mosquitto --home DIR`` writes its files into DIR and runs it. The functions add grants by
``function_app.adapters.local.broker_access.MosquittoBrokerAccess``.
"""
