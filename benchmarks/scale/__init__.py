"""How far one machine goes: brokers, agents, functions, and what each more robot or connection costs.

``limits.json`` and ``swarm.json`` are what ``benchmarks.sheet`` computes ``docs/results/scale.md`` from.
"""
