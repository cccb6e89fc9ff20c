"""Every state of lease and epoch, with the real rules: at most one operator moves the device."""

import re

import pytest

from tests.harness.paths import ROOT
from tests.simulation.checks.lease_model import LeaseModel, NextEpoch, Restore

STATES = 10_724
"""Distinct states up to epoch 3; TLC finds the same number (decision 0081)."""


@pytest.mark.parametrize("restore", ["never", "fresh"])
def test_at_most_one_operator_moves_the_device(restore: Restore) -> None:
    result = LeaseModel(max_epoch=3, restore=restore).explore()
    assert result.trace == ()
    assert result.states == STATES


@pytest.mark.parametrize("next_epoch", ["cloud", "device"])
def test_a_restore_that_brings_old_epochs_back_lets_two_operators_move_the_device(next_epoch: NextEpoch) -> None:
    result = LeaseModel(max_epoch=3, next_epoch=next_epoch, restore="old").explore()
    assert result.trace == ("acquire(a)", "restore", "acquire(b)", "grant(1, a)", "AtMostOneHolder")


def test_the_model_in_tla_has_the_same_actions() -> None:
    text = (ROOT / "docs/models/LeaseEpoch.tla").read_text()
    following = text[text.index("\nNext ==") : text.index("\nSpec ==")]
    actions = set(re.findall(r"\b([a-z_]{4,})\b", following)) - {"messages"}
    source = (ROOT / "tests/simulation/checks/lease_model.py").read_text()
    assert {action for action in actions if f'"{action}' not in source} == set()
