"""``trials``: measure how often a movement completes a task in simulation, without cloud and without real time."""

import argparse
import json
import sys
import time
from pathlib import Path

from device_agent.cli.arguments import Commands
from device_agent.cli.trials.publish import Publisher
from device_agent.cli.trials.success_rate import wilson_interval
from device_agent.config.errors import ConfigError
from device_agent.sandbox.host import SandboxHost

__all__ = ["add_commands"]

_PROGRESS_S = 5.0
"""Period of progress lines [s]."""


def add_commands(commands: Commands, _home: Path) -> None:
    """Add ``trials``."""
    parser = commands.add_parser("trials", help="measure the success rate of a task in simulation, without cloud")
    parser.add_argument("--task", required=True, metavar="TYPE/TASK", help="robot type, and task of its tasks.toml")
    parser.add_argument("--seeds", type=_positive, default=20, help="number of trials (default: %(default)s)")
    parser.add_argument("--first-seed", type=_seed, default=0, help="seed of the first trial (default: %(default)s)")
    parser.add_argument(
        "--at-least", type=_share, metavar="SHARE", help="exit with 1 if the success rate is lower, 0 to 1"
    )
    parser.add_argument("--report", type=Path, metavar="FILE", help="write the result of each trial as a line of JSON")
    parser.add_argument("--publish", metavar="URL", help="publish the results on this server, as a simulated batch")
    parser.add_argument("--api-key-file", type=Path, metavar="FILE", help="file with an API key of an operator")
    parser.add_argument("--ca", type=Path, metavar="FILE", help="certificate authority (PEM) of an https server")
    parser.set_defaults(command=_trials)


def _trials(options: argparse.Namespace) -> int:
    # Imported here: agents of real robots may have no MuJoCo.
    from device_agent.cli.trials.trial import TaskTrials, TrialResult  # noqa: PLC0415

    publisher = _publisher(options)
    sandbox = SandboxHost()
    results: list[TrialResult] = []
    lines: list[str] = []
    successes, reported_s = 0, time.monotonic()
    try:
        trials = TaskTrials(options.task, sandbox)
        for count, seed in enumerate(range(options.first_seed, options.first_seed + options.seeds), 1):
            result = trials.run(seed)
            results.append(result)
            successes += result.success
            fields = {name: getattr(result, name) for name in result.__dataclass_fields__}
            lines.append(json.dumps(fields | {"reason": result.reason}))
            if not result.success:
                print(f"seed {seed}: {result.reason}", flush=True)
            if time.monotonic() - reported_s >= _PROGRESS_S:
                reported_s = time.monotonic()
                print(f"{count} of {options.seeds} trials, {successes} successful", file=sys.stderr, flush=True)
    finally:
        sandbox.close()
        if options.report is not None:
            options.report.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
    rate, (lower, upper) = successes / options.seeds, wilson_interval(successes, options.seeds)
    print(
        f"{options.task}: {successes} of {options.seeds} trials successful, {rate:.1%} "
        f"(95 % interval {lower:.1%} to {upper:.1%})"
    )
    if publisher is not None:
        publisher.publish(options.task, trials.version, options.first_seed, results)
        print(f"published on {options.publish}")
    return int(options.at_least is not None and rate < options.at_least)


def _publisher(options: argparse.Namespace) -> Publisher | None:
    """Where to publish the results, checked before the trials run.

    Raises:
        ConfigError: The address or the key cannot be used.
    """
    if options.publish is None:
        return None
    if options.api_key_file is None:
        raise ConfigError("--publish needs --api-key-file, a file with an API key of an operator")
    return Publisher(options.publish, options.api_key_file, options.ca)


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not a number of trials; use 1 or more")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is not a seed; use 0 or more")
    return value


def _share(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{value:g} is not a share; use 0 to 1")
    return value
