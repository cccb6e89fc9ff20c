"""Decisions of the owner about recorded cameras: who may decide, order, storage, and their effect."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from device_agent.protocol import CameraConsent, SetCameraConsent
from device_agent.runtime.errors import Refused
from device_agent.runtime.recording.camera_consent import CameraConsents
from device_agent.runtime.storage.journal import Journal, JournalError

OWNER, SPACE = "account-of-ann", "lab"
CAMERAS = ("front", "wrist")


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    journal = Journal(tmp_path / "journal.db")
    journal.open(now_ms=0)
    yield journal
    journal.close()


@pytest.fixture
def consents(journal: Journal) -> CameraConsents:
    return CameraConsents(journal, space=SPACE, account=OWNER)


def decide(consents: CameraConsents, number: int, *cameras: str, account: str = OWNER) -> bool:
    request = SetCameraConsent(cameras=cameras, account=account, number=number)
    return consents.decide("arm", CAMERAS, request, caller="ann")


def permitted(consents: CameraConsents) -> list[str]:
    return [camera for camera in CAMERAS if consents.permits("arm", camera, time.monotonic())]


def code(consents: CameraConsents, number: int, *cameras: str, account: str = OWNER) -> str:
    with pytest.raises(Refused) as refused:
        decide(consents, number, *cameras, account=account)
    return refused.value.code


def test_without_a_decision_no_camera_may_be_recorded(consents: CameraConsents) -> None:
    assert consents.of("arm") == CameraConsent()
    assert permitted(consents) == []


def test_consent_holds_for_the_named_cameras_and_for_pictures_taken_from_now_on(consents: CameraConsents) -> None:
    before_s = time.monotonic()
    assert decide(consents, 1, "wrist")
    assert permitted(consents) == ["wrist"]
    assert not consents.permits("arm", "wrist", before_s)
    assert not consents.permits("other", "wrist", time.monotonic())
    consent = consents.of("arm")
    assert (consent.cameras, consent.by, consent.number) == (("wrist",), "ann", 1)
    assert abs(consent.at_ms - time.time() * 1000) < 60_000


def test_another_camera_does_not_interrupt_a_recorded_one(consents: CameraConsents) -> None:
    decide(consents, 1, "front")
    taken_s = time.monotonic()
    decide(consents, 2, "front", "wrist")
    assert consents.permits("arm", "front", taken_s)
    assert not consents.permits("arm", "wrist", taken_s)


def test_a_withdrawal_is_in_force_at_once_and_an_old_consent_does_not_return(consents: CameraConsents) -> None:
    decide(consents, 1, "front")
    decide(consents, 2)
    assert permitted(consents) == []
    assert code(consents, 1, "front") == "outdated"
    assert code(consents, 2, "front") == "outdated"
    assert not decide(consents, 2), "the same decision once more"
    assert permitted(consents) == []


def test_only_the_owner_of_the_agent_may_decide(consents: CameraConsents, journal: Journal) -> None:
    assert code(consents, 1, "front", account="account-of-bob") == "not_owner"
    unpaired = CameraConsents(journal, space=SPACE, account="")
    assert code(unpaired, 1, "front", account="") == "not_owner"
    assert permitted(consents) == []


def test_an_unknown_camera_is_named(consents: CameraConsents) -> None:
    with pytest.raises(Refused, match="no camera 'rear' can be recorded here; there are: front, wrist"):
        decide(consents, 1, "rear")
    request = SetCameraConsent(cameras=("rear",), account=OWNER, number=1)
    with pytest.raises(Refused, match="there are: none"):
        consents.decide("arm", (), request, caller="ann")


def test_a_withdrawal_is_in_force_although_a_camera_is_unknown(consents: CameraConsents, journal: Journal) -> None:
    decide(consents, 1, "front", "wrist")
    assert code(consents, 2, "wrist", "removed") == "unknown_camera"
    assert permitted(consents) == ["wrist"]
    assert permitted(CameraConsents(journal, space=SPACE, account=OWNER)) == ["wrist"]
    assert code(consents, 1, "front", "wrist") == "outdated"


def test_a_restart_keeps_the_decision(consents: CameraConsents, journal: Journal) -> None:
    decide(consents, 4, "front")
    restarted = CameraConsents(journal, space=SPACE, account=OWNER)
    assert restarted.of("arm") == consents.of("arm")
    assert permitted(restarted) == ["front"]
    decide(restarted, 5)
    again = CameraConsents(journal, space=SPACE, account=OWNER)
    assert permitted(again) == []
    assert code(again, 4, "front") == "outdated"


@pytest.mark.parametrize(("space", "account"), [("other-room", OWNER), (SPACE, "account-of-bob")])
def test_consent_ends_with_another_room_or_owner(
    consents: CameraConsents, journal: Journal, space: str, account: str
) -> None:
    decide(consents, 4, "front")
    moved = CameraConsents(journal, space=space, account=account)
    assert moved.of("arm") == CameraConsent(number=4)
    assert permitted(moved) == []
    assert code(moved, 4, "front", account=account) == "outdated"


def test_a_record_that_cannot_be_read_is_no_consent(consents: CameraConsents, journal: Journal) -> None:
    journal.save_camera_consent("arm", 3, b"{")
    assert consents.of("arm") == CameraConsent(number=3)
    assert permitted(consents) == []


def test_a_failed_disk_prevents_consent_but_not_a_withdrawal(consents: CameraConsents, journal: Journal) -> None:
    decide(consents, 1, "front")
    journal.close()
    with pytest.raises(JournalError):
        decide(consents, 2, "wrist")
    assert permitted(consents) == []
    assert consents.of("arm").number == 1, "the cloud repeats the decision"
