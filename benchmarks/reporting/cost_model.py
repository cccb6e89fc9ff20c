"""Cost and limits on paper: ``python -m benchmarks.reporting.cost_model`` writes docs/results/scale.md from the files in benchmarks/scale.

``swarm.json`` is what the last whole run of the suite ``scale`` has measured, ``limits.json`` what is assumed, and
limits and prices with their source. A price that is not known stands in the sheet by its name. ``--check`` only looks whether the page is new.
"""
# ruff: noqa: E501 (lines of the page stand here as they will there)

import json
import math
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
SCALE = ROOT / "benchmarks" / "scale"
PAGE = ROOT / "docs" / "results" / "scale.md"
MONTH_S = 30 * 86_400
_FEW = 10
Known = Mapping[str, Any]


def demand(assumed: Known, robots: int, hz: float, message_bytes: float) -> dict[str, float]:
    """What so many robots ask for."""
    steady_hz = hz + 1 / assumed["state_every_s"]["value"]
    answers = assumed["commands_a_day"]["value"] * (assumed["answers_a_command"]["value"] + 1) / 86_400
    stores = min(hz, 1 / assumed["stored_every_s"]["value"])
    good_s = assumed["credentials_good_s"]["value"] * assumed["credentials_renewed_at"]["value"]
    return {
        "connections": robots,
        "in_per_s": robots * (steady_hz + answers),
        "in_bytes_per_s": robots * (steady_hz + answers) * message_bytes,
        "out_per_s": robots * (steady_hz + answers) * assumed["subscribers"]["value"],
        "retained": robots * assumed["retained_a_robot"]["value"],
        "stores_per_s": robots * stores,
        "write_units_per_s": robots * stores * assumed["rows_a_store"]["value"] * assumed["write_units_a_row"]["value"],
        "credentials_per_s": robots / good_s,
    }


def message_bytes(swarm: Known) -> float:
    """A message's topic and payload, on average over all that was sent in all runs."""
    counts = [run["counts"] for run in swarm["runs"]]
    return float(sum(each["out_bytes"] for each in counts) / sum(each["out"] for each in counts))


def slope_s(steps: list[dict[str, float]]) -> float:
    """How much more processor time of mosquitto each further agent costs for each agent it knows (least squares) [s]."""
    xs = [step["known"] for step in steps]
    ys = [step["processor_ms_each"] / 1000 for step in steps]
    middle_x, middle_y = sum(xs) / len(xs), sum(ys) / len(ys)
    above = sum((x - middle_x) * (y - middle_y) for x, y in zip(xs, ys, strict=True))
    return above / sum((x - middle_x) ** 2 for x in xs)


def cost(prices: Known, name: str, millions: float) -> str:
    """So many millions at a price, or the formula where it is not known."""
    value = prices[name]["value"]
    return f"{millions:,.4g} x {name}" if value is None else f"{millions * value:,.0f} $"


def main() -> int:
    """Write the page, or look whether it is what would be written."""
    if "--check" in sys.argv:
        return 0 if PAGE.read_text(encoding="utf-8") == "\n".join(lines()) + "\n" else 1
    write()
    return 0


def write() -> None:
    """The page."""
    PAGE.write_text("\n".join(lines()) + "\n", encoding="utf-8")


def keep(swarm: Known) -> None:
    """What was measured, in place of what was measured before; the page follows."""
    (SCALE / "swarm.json").write_text(json.dumps(swarm, indent=1) + "\n", encoding="utf-8")
    write()


def lines() -> Iterator[str]:
    """The page."""
    swarm = json.loads((SCALE / "swarm.json").read_text(encoding="utf-8"))
    facts = json.loads((SCALE / "limits.json").read_text(encoding="utf-8"))
    size = message_bytes(swarm)
    yield "# Ten thousand robots, and a million: on paper"
    yield ""
    yield "Made by `python -m benchmarks.reporting.cost_model` from `benchmarks/scale/`; nothing here is typed by hand. No cloud was asked: what was"
    yield "measured is the swarm's own messages and mosquitto's processor time, all else is arithmetic on assumptions, limits and prices"
    yield "with their source. A price without a source stands as its name."
    yield ""
    yield from _measured(swarm, size)
    yield from _demands(facts, size)
    yield from _limits(facts, size)
    yield from _own_broker(swarm, facts)
    yield from _money(facts, size)
    yield from _sources(facts)


def _measured(swarm: Known, size: float) -> Iterator[str]:
    yield "## Measured: one process of the swarm"
    yield ""
    yield f"A message is {size:,.0f} bytes on average, topic and payload, for an arm of 6 joints. The product and a subscriber run on the same two cores;"
    yield "`load` is the mean number of processes that wanted one of them before and after. Lag and what was missed are the swarm's own. `lost` is what a"
    yield "subscriber at QoS 0 did not get."
    yield ""
    yield "| broker | agents | Hz | connected | sent/s | missed | lost | loop's lag p50, p99 ms | confirmed p50, p99 ms | µs of processor a message | kB an agent | load |"
    yield "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for run in swarm["runs"]:
        lag, confirm = run["lag_ms"], run["confirm_ms"]
        yield (
            f"| {run['broker']} | {run['agents']} | {run['rate_hz']:g} | {run['most_connected']} | {run['out_per_s']:,.0f} "
            f"| {run['missed_share']:.1%} | {run['lost_share']:.1%} | {lag['p50']:.0f}, {lag['p99']:.0f} "
            f"| {confirm['p50']:.0f}, {confirm['p99']:.0f} | {_each(run)} "
            f"| {run['memory_bytes_per_agent'] / 1000:.0f} | {run['load_before']:.0f}, {run['load_after']:.0f} |"
        )
    yield ""


def _each(run: Known) -> str:
    """Processor time of a message [µs], where enough were sent to tell it."""
    return f"{run['cpu_share'] / run['out_per_s'] * 1e6:,.0f}" if run["out_per_s"] > _FEW else "-"


def _demands(facts: Known, size: float) -> Iterator[str]:
    assumed = facts["assumed"]
    yield "## Asked for"
    yield ""
    yield "| assumed | | why |"
    yield "| --- | --- | --- |"
    for name, entry in assumed.items():
        if isinstance(entry, dict):
            yield f"| `{name}` | {entry['value']} | {entry['why']} |"
    yield ""
    names = ("in_per_s", "in_bytes_per_s", "retained", "stores_per_s", "write_units_per_s", "credentials_per_s")
    yield "| robots | Hz | messages in/s | bytes in/s | retained | table transactions/s | write units/s | credentials/s |"
    yield "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for robots in assumed["robots"]:
        for hz in assumed["measures_hz"]["value"]:
            wanted = demand(assumed, robots, hz, size)
            yield f"| {robots:,} | {hz} | " + " | ".join(f"{wanted[name]:,.4g}" for name in names) + " |"
    yield ""


def _limits(facts: Known, size: float) -> Iterator[str]:
    assumed, units = facts["assumed"], facts["units"]
    yield "## Units, and what is full first"
    yield ""
    yield "How many of each are needed; `full at` is the number of robots that fill one. The smallest of a cloud is its first bottleneck."
    yield ""
    sizes = [(robots, hz) for robots in assumed["robots"] for hz in assumed["measures_hz"]["value"]]
    yield (
        "| cloud | one | "
        + " | ".join(f"{robots:,} at {hz} Hz" for robots, hz in sizes)
        + " | full at, 20 Hz | full at, 1 Hz |"
    )
    yield "| --- | --- |" + " ---: |" * (len(sizes) + 2)
    for cloud, limits in facts["limits"].items():
        for limit in limits:
            needed = [
                math.ceil(demand(assumed, robots, hz, size)[limit["of"]] / limit["value"]) for robots, hz in sizes
            ]
            full = [limit["value"] / demand(assumed, 1, hz, size)[limit["of"]] for hz in (20, 1)]
            cells = [f"{each:,}" for each in needed] + [f"{each:,.0f}" for each in full]
            yield f"| {cloud} | {limit['name']}: {limit['value']:,} | " + " | ".join(cells) + " |"
    yield ""
    a_namespace = units["throughput_units_of_a_namespace"]["value"]
    for cloud, limits in facts["limits"].items():
        for hz in assumed["measures_hz"]["value"]:
            fills = {limit["name"]: limit["value"] / demand(assumed, 1, hz, size)[limit["of"]] for limit in limits}
            first = min(fills, key=lambda name: fills[name])
            yield f"- First bottleneck, {cloud}, {hz} Hz: **{first}**, at {fills[first]:,.0f} robots."
            if "throughput unit" in first:
                yield f"  A namespace of {a_namespace} units is full at {fills[first] * a_namespace:,.0f} robots."
    for robots, hz in sizes:
        needed_units = _throughput_units(facts, robots, hz, size)
        spaces = math.ceil(needed_units / a_namespace)
        full_subscription = spaces / units["namespaces_of_a_subscription"]["value"]
        yield (
            f"- Azure, {robots:,} at {hz} Hz: {needed_units:,} throughput units, {spaces:,} namespaces of {a_namespace}, "
            f"{math.ceil(full_subscription):,} subscription(s)."
        )
    for robots in assumed["robots"]:
        back_s = robots / units["connects_per_s"]["value"]
        yield f"- AWS, {robots:,} robots that have lost one link together are back after {back_s:,.0f} s at the soonest."
    yield ""
    yield "Telescope speaks to one broker address: beyond one namespace a fleet is several Telescopes, by account or region. Partitions are no bottleneck: each"
    yield "device and stream has its own, and one asks for half a transaction a second."
    yield ""


def _throughput_units(facts: Known, robots: int, hz: float, size: float) -> int:
    wanted = demand(facts["assumed"], robots, hz, size)
    of_units = [limit for limit in facts["limits"]["azure"] if "throughput unit" in limit["name"]]
    return max(math.ceil(wanted[str(limit["of"])] / float(limit["value"])) for limit in of_units)


def _own_broker(swarm: Known, facts: Known) -> Iterator[str]:
    steps = swarm["credentials"]["steps"]
    slope, assumed = slope_s(steps), facts["assumed"]
    good_s = assumed["credentials_good_s"]["value"]
    renewed_s = good_s * assumed["credentials_renewed_at"]["value"]
    # What is renewed stays known until it runs out.
    known = good_s / renewed_s
    most = math.sqrt(renewed_s / (slope * known))
    seen = ", ".join(f"{step['processor_ms_each']:g} ms at {step['known']}" for step in steps)
    yield "## A site's own broker"
    yield ""
    yield "mosquitto's dynamic security writes all it knows to its file at each change, in the thread that also passes messages on: a further agent costs"
    yield f"{slope * 1e6:,.0f} µs of processor for each agent that it knows already ({seen})."
    yield f"Renewing alone, spread evenly, fills that thread at {most:,.0f} agents, and a tenth of it at {most * math.sqrt(0.1):,.0f};"
    yield f"{1000:,} agents that connect one after another, as after a new start of the site, take it {slope * 1000**2 / 2:,.0f} s, in which it passes on little else:"
    yield "where many start together this is felt before the number of messages is. The embedded broker reads signed tokens instead and writes nothing."
    yield ""


def _money(facts: Known, size: float) -> Iterator[str]:
    assumed, prices, units = facts["assumed"], facts["prices_usd"], facts["units"]
    yield "## A month (30 days), in dollars"
    yield ""
    yield "| robots | Hz | AWS messages in | AWS rules | AWS connections | AWS tables | Azure units | Azure operations | Azure tables |"
    yield "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
    for robots in assumed["robots"]:
        for hz in assumed["measures_hz"]["value"]:
            wanted = demand(assumed, robots, hz, size)
            metered = math.ceil(size / units["metered_bytes"]["value"])
            month = MONTH_S / 1e6
            cells = (
                cost(prices, "AWS_MESSAGES", wanted["in_per_s"] * metered * month),
                cost(prices, "AWS_RULES", wanted["in_per_s"] * month),
                cost(prices, "AWS_MINUTES", robots * MONTH_S / 60 / 1e6),
                cost(prices, "AWS_WRITE_UNITS", wanted["write_units_per_s"] * month),
                f"{_throughput_units(facts, robots, hz, size) * MONTH_S / 3600:,.4g} x AZURE_UNIT_HOUR",
                cost(prices, "AZURE_OPERATIONS", (wanted["in_per_s"] + wanted["out_per_s"]) * month),
                cost(prices, "AZURE_TABLE", wanted["stores_per_s"] * month),
            )
            yield f"| {robots:,} | {hz} | " + " | ".join(cells) + " |"
    yield ""
    yield "The price of the first billion messages is taken for all of them: those after are cheaper, so this is the most. Left out: that a state kept by the broker"
    yield "counts twice, pages that watch, the functions' time and calls, storage, traffic. AWS takes pings every 30 s for nothing; an"
    yield "agent pings every 4 s, and what that costs is not in the source."
    yield ""
    answers = assumed["answers_a_command"]["value"]
    yield "### A million commands"
    yield ""
    yield "One call of the API, one message in and out to the robot, its answers, and a call of the functions for each of them:"
    yield ""
    yield f"- AWS: {1 + answers} x {prices['AWS_CALLS']['value']} + {2 + answers} x {prices['AWS_MESSAGES']['value']} + {answers} x AWS_RULES + {1 + answers} x FUNCTION_SECONDS + tables"
    aws = (1 + answers) * prices["AWS_CALLS"]["value"] + (2 + answers) * prices["AWS_MESSAGES"]["value"]
    yield f"  = **{aws:.2f} $** + {answers} x AWS_RULES + {1 + answers} x FUNCTION_SECONDS + tables"
    azure = (1 + answers) * prices["AZURE_CALLS"]["value"]
    yield f"- Azure: **{azure:.2f} $** + {2 + 2 * answers} x AZURE_OPERATIONS + {1 + answers} x FUNCTION_SECONDS + tables"
    yield ""


def _sources(facts: Known) -> Iterator[str]:
    yield "## Sources"
    yield ""
    yield "| what | value | source | dated |"
    yield "| --- | ---: | --- | --- |"
    for limits in facts["limits"].values():
        for limit in limits:
            yield f"| {limit['name']} | {limit['value']:,} | {limit['source']} | {limit['dated']} |"
    for name, unit in facts["units"].items():
        yield f"| `{name}` | {unit['value']:,} | {unit['source']} | {unit['dated']} |"
    for name, price in facts["prices_usd"].items():
        known = price["value"] is not None
        value = f"{price['value']} $" if known else "not known"
        yield f"| `{name}`, a {price['each']} | {value} | {price.get('source', '')} | {price.get('dated', '')} |"


if __name__ == "__main__":
    sys.exit(main())
