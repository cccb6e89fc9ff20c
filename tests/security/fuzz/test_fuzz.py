"""A short fuzz run of each parser of untrusted input; ``make fuzz`` runs longer."""

import sys

import pytest

from tests.security.fuzz import instrumented
from tests.security.fuzz.session import Crashed, fuzz
from tests.security.fuzz.targets import TARGETS, Found, _check_finite

SLOW = ("home", "robot_type")


@pytest.mark.skipif(sys.platform != "linux", reason="the fuzzer atheris is installed on Linux only")
@pytest.mark.parametrize(("slow", "runs"), [(False, 2000), (True, 300)], ids=["quick", "slow"])
def test_parsers_raise_only_documented_errors(slow: bool, runs: int) -> None:
    assert set(TARGETS) == set(instrumented.MODULES)
    sessions = list(fuzz([name for name in TARGETS if (name in SLOW) == slow], f"-runs={runs}", "-seed=1"))
    print(*(session.row for session in sessions), sep="\n")
    assert all(session.runs >= runs for session in sessions)
    assert all(session.end > session.empty for session in sessions), "the fuzzer measures no coverage"


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("http", b'\0\0{"ageexpires_in_s": 600.0, "state": "a", "keys": []}'),
        ("http", b'\0\0{"agent": "a", "expires_in_s": "soon"}'),
        ("http", b'\0\2{"lifetime_s": NaN}'),
        ("home", b'{"agent": "a", "space": "s", "account": "s", "keys": {"k": "A\xc0A"}, "owner": ""}'),
    ],
)
def test_earlier_findings_stay_fixed(name: str, found: bytes) -> None:
    TARGETS[name].run(found)


def test_every_example_passes() -> None:
    for target in TARGETS.values():
        for seed in target.seeds:
            target.run(seed)


def test_a_non_finite_number_is_found_at_any_depth() -> None:
    with pytest.raises(Found):
        _check_finite({"a": [1, ({"b": float("nan")},)]})


def test_a_crash_is_reported_with_its_input() -> None:
    with pytest.raises(Crashed, match="no-such-parser"):
        list(fuzz(["no-such-parser"]))
