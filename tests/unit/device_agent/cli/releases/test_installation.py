"""The installation: atomic links, pruning, the lock, and the remedy for other installations."""

import os
from pathlib import Path

import pytest

from device_agent.cli.releases import commands
from device_agent.cli.releases.installation import Installation, PendingTrial
from device_agent.config.errors import ConfigError
from tests.harness.agent.stub_installation import StubInstallation


@pytest.fixture
def stub(tmp_path: Path) -> StubInstallation:
    stub = StubInstallation(tmp_path, "1", "2", "3", "4", user="robot")
    for age, version in enumerate(("4", "3", "2", "1")):
        os.utime(stub.prefix / "releases" / version, (1e9 - age, 1e9 - age))
    return stub


def test_the_newest_releases_and_both_links_are_kept(stub: StubInstallation) -> None:
    stub.installation.link("previous", "2")
    assert stub.installation.prune(3) == ["3"]
    assert sorted(path.name for path in (stub.prefix / "releases").iterdir()) == ["1", "2", "4"]
    assert stub.installation.prune(2) == ["4"]
    assert stub.installation.prune(2) == []


def test_an_unfinished_release_is_not_listed(stub: StubInstallation) -> None:
    (stub.prefix / "releases/4/.complete").unlink()
    assert stub.installation.versions() == ["3", "2", "1"]
    assert not stub.installation.is_complete("4")


def test_a_link_is_replaced_and_removed(stub: StubInstallation) -> None:
    stub.installation.link("previous", "2")
    stub.installation.link("previous", "3")
    assert stub.installation.linked("previous") == "3"
    stub.installation.link("previous", "")
    stub.installation.link("previous", "")
    assert stub.installation.linked("previous") == ""
    assert sorted(path.name for path in stub.prefix.iterdir()) == ["bin", "current", "installation", "releases"]


def test_two_programs_cannot_change_it_at_once(stub: StubInstallation) -> None:
    again = stub.installation.lock()
    with stub.installation.lock(), pytest.raises(ConfigError, match="another program changes"), again:
        pass
    with stub.installation.lock():
        pass


def test_an_interrupted_switch_to_a_failed_release_is_undone(stub: StubInstallation) -> None:
    stub.installation.write_trial(PendingTrial.new("2", needs_link=False, timeout_s=5.0, before="3"))
    stub.installation.link("previous", "1")
    stub.installation.link("current", "2")
    assert stub.installation.settle() == ""
    assert stub.installation.trial() is not None, "still pending"
    stub.write_result("failed it does not start")
    assert stub.installation.settle() == "release 2 failed (it does not start); release 1 is in use again"
    assert stub.links == ("1", "3")


def test_an_agent_that_was_installed_in_another_way_names_the_remedy() -> None:
    with pytest.raises(ConfigError, match="pipx upgrade telescope-agent"):
        Installation.of_this_program()


def test_a_folder_without_an_installation_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        Installation(tmp_path)


@pytest.mark.parametrize("text", ["-1", "1e9"])
def test_times_have_limits(text: str) -> None:
    with pytest.raises(Exception, match="between 0 s and a week"):
        commands._seconds(text)


@pytest.mark.parametrize("text", ["1", "101"])
def test_the_release_before_is_always_kept(text: str) -> None:
    with pytest.raises(Exception, match="between 2 and 100"):
        commands._count(text)
