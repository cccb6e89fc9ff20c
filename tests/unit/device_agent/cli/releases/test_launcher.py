"""The launcher: which release it starts, before, during and after a trial."""

from pathlib import Path

import pytest

from device_agent.cli.releases.installation import PendingTrial
from tests.harness.agent.stub_installation import StubInstallation


@pytest.fixture
def stub(tmp_path: Path) -> StubInstallation:
    """Release 2 is on trial, and release 1 was in use before."""
    stub = StubInstallation(tmp_path, "1", "2")
    stub.installation.write_trial(PendingTrial("t1", "2", needs_link=True, timeout_s=90.0, before=""))
    stub.installation.link("previous", "1")
    stub.installation.link("current", "2")
    return stub


def test_a_release_on_trial_is_told_its_conditions_and_counted(stub: StubInstallation) -> None:
    assert stub.run("--log-format", "json", "run").stdout == "2 t1 1 90\n"
    trial = stub.installation.trial()
    assert trial is not None
    assert stub.installation.result(trial) == ("1", "")
    assert (stub.home / "release-trial").stat().st_mode & 0o077 == 0


def test_a_release_that_ends_three_times_is_replaced_for_good(stub: StubInstallation) -> None:
    assert [stub.started() for _ in range(5)] == ["2", "2", "2", "1", "1"]
    last = stub.run()
    assert last.stdout == "1 \n", "the former release is not on trial"
    assert "release 2 has failed; starting the release before it" in last.stderr
    assert stub.installation.settle() == (
        "release 2 failed (it ended 3 times before it was ready); release 1 is in use again"
    )
    assert stub.links == ("1", "")
    assert stub.started() == "1"


def test_a_release_that_has_passed_is_started_without_trial(stub: StubInstallation) -> None:
    stub.write_result("passed")
    assert [stub.run().stdout for _ in range(5)] == ["2 \n"] * 5
    assert stub.installation.settle() == ""
    assert stub.installation.trial() is None


def test_other_commands_use_the_release_in_use_and_are_not_counted(stub: StubInstallation) -> None:
    for _ in range(5):
        assert stub.run("doctor").stdout == "2 \n"
    assert stub.started() == "2"


@pytest.mark.parametrize("content", ["t1 12\n", "t1 x\n", "t1 \n"])
def test_with_a_damaged_count_the_former_release_is_started(stub: StubInstallation, content: str) -> None:
    (stub.home / "release-trial").write_text(content)
    assert stub.started() == "1"


def test_a_result_of_an_earlier_trial_does_not_count(stub: StubInstallation) -> None:
    (stub.home / "release-trial").write_text("t0 failed\n")
    assert stub.started() == "2"


def test_a_trial_of_a_release_that_is_not_in_use_does_not_count(stub: StubInstallation) -> None:
    stub.installation.link("current", "1")
    assert stub.run().stdout == "1 \n"
    assert stub.installation.trial() is None
    assert stub.installation.settle() == ""
    assert not (stub.prefix / "trial").exists()


def test_a_folder_that_cannot_be_written_leads_to_the_former_release(stub: StubInstallation) -> None:
    (stub.prefix / "installation").write_text("home=/proc/missing\n")
    assert stub.started() == "1"


def test_an_incomplete_release_is_replaced_and_without_any_the_remedy_is_named(stub: StubInstallation) -> None:
    (stub.prefix / "releases/2/bin/telescope-agent").unlink()
    assert stub.started() == "1"
    (stub.prefix / "releases/1/bin/telescope-agent").unlink()
    done = stub.run()
    assert (done.returncode, "run install-agent.sh again" in done.stderr) == (1, True)
