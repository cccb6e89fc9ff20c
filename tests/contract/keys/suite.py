"""Contract of ``SigningKeys``. The test of an adapter inherits the class and supplies the fixtures.

``keys``: opened over an empty place. ``again``: opens the same place as another process does.
"""

from collections.abc import Callable

import jwt
import pytest

from device_agent.protocol import codec
from device_agent.protocol.errors import SignatureError
from device_agent.protocol.security import signing
from device_agent.protocol.security.key_rotation import KEYS_CONTEXT, NewKey
from function_app.ports.signing_keys import RotationRefused, SigningKeys

Again = Callable[[], SigningKeys]
LEARN_MS, OVERLAP_MS = 1000, 5000


class Time:
    """A manually advanced wall clock."""

    def __init__(self) -> None:
        self.ms = 1_800_000_000_000

    def now_ms(self) -> int:
        return self.ms


async def key_ids(keys: SigningKeys) -> tuple[str, str]:
    """Ids of the key for tokens and of that for commands."""
    current, devices = await keys.current(), await keys.for_devices()
    return signing.key_id(current.public_key()), signing.key_id(devices.public_key())


async def rotate(keys: SigningKeys) -> str:
    """The new key's id."""
    return (await keys.rotate(learn_ms=LEARN_MS, overlap_ms=OVERLAP_MS)).pins[-1].id


class KeysSuite:
    """Contract of ``SigningKeys``."""

    pytestmark = pytest.mark.anyio

    async def test_all_instances_sign_with_the_same_key(self, keys: SigningKeys, again: Again) -> None:
        first = await key_ids(keys)
        assert [await key_ids(again()) for _ in range(3)] == [first] * 3
        assert set(await keys.public()) == {first[0]}

    async def test_a_new_key_signs_tokens_immediately_and_commands_after_the_learning_time(
        self, keys: SigningKeys, time: Time
    ) -> None:
        old, _ = await key_ids(keys)
        new = await rotate(keys)
        assert await key_ids(keys) == (new, old)
        time.ms += LEARN_MS
        assert await key_ids(keys) == (new, new)
        time.ms += OVERLAP_MS - LEARN_MS - 1
        assert set(await keys.public()) == {old, new}
        assert (await keys.announcement()).statements != ()
        time.ms += 1
        assert set(await keys.public()) == {new}
        assert [pin.id for pin in (await keys.announcement()).pins] == [new]
        assert (await keys.announcement()).statements == ()
        assert set(await keys.archive()) == {old, new}

    async def test_statements_link_an_old_key_to_the_newest_across_rotations(
        self, keys: SigningKeys, time: Time
    ) -> None:
        old, _ = await key_ids(keys)
        pinned = dict(await keys.public())
        new = await rotate(keys)
        until_ms = time.ms + OVERLAP_MS
        assert [(pin.id, pin.serial, pin.until_ms) for pin in (await keys.announcement()).pins] == [
            (old, 1, until_ms),
            (new, 2, 0),
        ]
        time.ms += LEARN_MS
        newest = await rotate(keys)
        learned = []
        for statement in (await keys.announcement()).statements:
            with pytest.raises(SignatureError):
                signing.verify(statement.encode(), pinned)
            message = codec.decode(signing.verify(statement.encode(), pinned, context=KEYS_CONTEXT), NewKey)
            key = signing.public_key(message.key)
            pinned[signing.key_id(key)] = key
            learned.append((signing.key_id(key), message.serial, message.former_until_ms))
        assert learned == [(new, 2, until_ms), (newest, 3, time.ms + OVERLAP_MS)]

    async def test_no_rotation_while_devices_learn_the_last_key(self, keys: SigningKeys, time: Time) -> None:
        await rotate(keys)
        with pytest.raises(RotationRefused) as refused:
            await rotate(keys)
        assert refused.value.until_ms == time.ms + LEARN_MS

    async def test_a_leaked_key_is_invalid_everywhere(self, keys: SigningKeys) -> None:
        old, _ = await key_ids(keys)
        middle = await rotate(keys)
        await keys.rotate(leaked=True)
        new, devices = await key_ids(keys)
        assert new == devices
        assert set(await keys.public()) == set(await keys.archive()) == {new}
        assert new not in {old, middle}
        assert (await keys.announcement()).statements == ()
        assert (await keys.announcement()).serial == 3

    async def test_another_process_finds_a_new_key_by_the_id_in_a_token(self, keys: SigningKeys, again: Again) -> None:
        other = again()
        await other.current()
        new = await rotate(keys)
        token = jwt.encode({}, await keys.current(), "EdDSA", headers={"kid": new})
        kid = jwt.get_unverified_header(token)["kid"]
        assert kid in await other.public(kid)

    async def test_another_process_signs_with_the_new_key_later(
        self, keys: SigningKeys, again: Again, time: Time
    ) -> None:
        other = again()
        await other.current()
        await rotate(keys)
        time.ms += LEARN_MS
        self.wait_for_followers(time)
        assert await key_ids(other) == await key_ids(keys)

    async def test_unused_private_keys_are_deleted(self, keys: SigningKeys, time: Time) -> None:
        await rotate(keys)
        time.ms += LEARN_MS
        await rotate(keys)
        time.ms += OVERLAP_MS
        await rotate(keys)
        ring = await keys._ring()  # type: ignore[attr-defined]
        assert [bool(key.private) for key in ring.keys] == [False, False, True, True]

    def wait_for_followers(self, time: Time) -> None:
        """Advance the clock until other processes read the keys again."""
