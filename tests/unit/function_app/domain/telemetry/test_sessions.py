"""Sessions merge independent reports; autonomy follows the papers' definitions."""

import itertools

import pytest

from function_app.domain.telemetry.sessions import Autonomy, Session, total

TAKEN = ("control-taken", 1_000, {"holder": "anna", "epoch": 3, "action": "a"})
RELEASED = ("control-released", 9_000, {"holder": "anna", "epoch": 3})
MERGED = Session(
    3,
    holder="anna",
    action="a",
    started_ms=1_000,
    ended_ms=9_000,
    start="control-taken",
    end="control-released",
    operator_s=2.0,
    machine_s=4.0,
    first_input_s=0.5,
)


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
def test_reports_in_any_order_give_the_same_session(order: tuple[int, ...]) -> None:
    changes = [
        lambda session: session.with_control(*TAKEN),
        lambda session: session.with_control(*RELEASED),
        lambda session: session.with_activity(2.0, 1.0, 0.5),
        lambda session: session.with_activity(1.0, 4.0, None),
    ]
    session = Session(3)
    for number in order:
        session = changes[number](session)
    assert session == MERGED
    for change in changes:
        assert change(session) == session, "a repeated report has no effect"


def test_other_events_and_a_second_end_do_not_change_a_session() -> None:
    assert MERGED.with_control("stop-ordered", 5_000, {}) == MERGED
    assert MERGED.with_control("control-expired", 99_000, {}) == MERGED


@pytest.mark.parametrize(
    ("sums", "hti", "mti", "mtia"),
    [
        (Autonomy(), None, None, None),
        (Autonomy(3.0, 1.0), 0.75, 0.25, 1 / 3),
        (Autonomy(2.0, 0.0), 1.0, 0.0, 0.0),
        (Autonomy(0.0, 5.0), 0.0, 1.0, None),
    ],
)
def test_autonomy(sums: Autonomy, hti: float | None, mti: float | None, mtia: float | None) -> None:
    assert (sums.hti, sums.mti, sums.mtia) == (hti, mti, mtia)
    assert sums.hti is None or sums.hti + (sums.mti or 0) == pytest.approx(1.0)


def test_sums_of_sessions() -> None:
    assert total([MERGED, Session(4, operator_s=1.0)]) == Autonomy(3.0, 4.0)
    assert total([]) == Autonomy()
