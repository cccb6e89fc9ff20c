"""How far one machine goes: brokers, agents, functions, and what each more robot or connection costs.

``limits.json`` and ``swarm.json`` are what ``benchmarks.reporting.cost_model`` computes ``docs/results/scale.md`` from.
"""
