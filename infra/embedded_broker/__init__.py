"""The embedded broker: amqtt, hardened, for one machine. A site takes mosquitto, a cloud its own.

``python -m infra.embedded_broker --keys FILE`` runs it; ``tests/contract/brokers`` is what it promises.
"""
