"""Capacity of one machine: brokers, agents, functions, and the cost of an additional robot or connection.

``benchmarks.reporting.cost_model`` computes ``docs/results/scale.md`` from ``limits.json`` and ``swarm.json``.
"""
