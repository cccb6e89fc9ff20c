"""The embedded broker: hardened amqtt for one machine. Use mosquitto on a site, and the provider's broker in the cloud.

``python -m infra.embedded_broker --keys FILE`` runs it; ``tests/contract/brokers`` specifies its behaviour.
"""
