"""What every store of signing keys promises. A store's test inherits the class and gives the fixtures.

``keys``: opened over an empty place. ``again``: opens the same place as another process does.
"""

import asyncio
from collections.abc import Awaitable, Callable

import jwt
import pytest

from device_agent.protocol import codec
from device_agent.protocol.errors import SignatureError
from device_agent.protocol.security import signing
from device_agent.protocol.security.key_rotation import KEYS_CONTEXT, NewKey
from function_app.ports.signing_keys import RotationRefused, SigningKeys

Again = Callable[[], Awaitable[SigningKeys]]
LEARN_MS, OVERLAP_MS = 1000, 5000


class Time:
    """A wall clock that stands until it is moved."""

    def __init__(self) -> None:
        self.ms = 1_800_000_000_000

    def now_ms(self) -> int:
        return self.ms


async def named(keys: SigningKeys) -> tuple[str, str]:
    """Ids of the key for tokens and of that for devices."""
    current, devices = await keys.current(), await keys.for_devices()
    return signing.key_id(current.public_key()), signing.key_id(devices.public_key())


async def rotate(keys: SigningKeys) -> str:
    """The new key's id."""
    return (await keys.rotate(learn_ms=LEARN_MS, overlap_ms=OVERLAP_MS)).pins[-1].id


class KeysSuite:
    """Inherited by each."""

    pytestmark = pytest.mark.anyio

    async def test_everybody_signs_with_the_same_key(self, keys: SigningKeys, again: Again) -> None:
        first = await named(keys)
        others = await asyncio.gather(*(again() for _ in range(3)))
        assert [await named(each) for each in others] == [first] * 3
        assert set(await keys.public()) == {first[0]}

    async def test_a_new_key_signs_tokens_at_once_and_orders_once_it_could_be_learned(
        self, keys: SigningKeys, time: Time
    ) -> None:
        old, _ = await named(keys)
        new = await rotate(keys)
        assert await named(keys) == (new, old)
        assert set(await keys.public()) == {old, new}
        time.ms += LEARN_MS
        assert await named(keys) == (new, new)
        assert set(await keys.public()) == {old, new}

    async def test_an_old_key_counts_to_the_end_of_the_overlap_and_for_what_is_stored_beyond(
        self, keys: SigningKeys, time: Time
    ) -> None:
        old, _ = await named(keys)
        new = await rotate(keys)
        time.ms += OVERLAP_MS - 1
        assert set(await keys.public()) == {old, new}
        assert (await keys.news()).statements != ()
        time.ms += 1
        assert set(await keys.public()) == {new}
        assert [pin.id for pin in (await keys.news()).pins] == [new]
        assert (await keys.news()).statements == ()
        assert set(await keys.archive()) == {old, new}

    async def test_a_statement_leads_from_the_old_key_to_the_new_one(self, keys: SigningKeys, time: Time) -> None:
        old, _ = await named(keys)
        pinned = dict(await keys.public())
        new = await rotate(keys)
        news = await keys.news()
        (statement,) = news.statements
        told = codec.decode(signing.verify(statement.encode(), pinned, context=KEYS_CONTEXT), NewKey)
        assert signing.key_id(signing.public_key(told.key)) == new
        assert (told.serial, told.former_until_ms) == (2, time.ms + OVERLAP_MS)
        assert [(pin.id, pin.serial, pin.until_ms) for pin in news.pins] == [
            (old, 1, told.former_until_ms),
            (new, 2, 0),
        ]
        with pytest.raises(SignatureError):
            signing.verify(statement.encode(), pinned)

    async def test_who_has_missed_one_rotation_is_led_through_both(self, keys: SigningKeys, time: Time) -> None:
        pinned = dict(await keys.public())
        await rotate(keys)
        time.ms += LEARN_MS
        await rotate(keys)
        for statement in (await keys.news()).statements:
            told = codec.decode(signing.verify(statement.encode(), pinned, context=KEYS_CONTEXT), NewKey)
            half = signing.public_key(told.key)
            pinned[signing.key_id(half)] = half
        assert (await keys.news()).pins[-1].id in pinned

    async def test_no_rotation_while_devices_learn_the_last_key(self, keys: SigningKeys, time: Time) -> None:
        await rotate(keys)
        with pytest.raises(RotationRefused) as refused:
            await rotate(keys)
        assert refused.value.until_ms == time.ms + LEARN_MS

    async def test_a_key_that_has_leaked_counts_for_nothing(self, keys: SigningKeys) -> None:
        old, _ = await named(keys)
        middle = await rotate(keys)
        await keys.rotate(leaked=True)
        new, devices = await named(keys)
        assert new == devices
        assert set(await keys.public()) == set(await keys.archive()) == {new}
        assert new not in {old, middle}
        assert (await keys.news()).statements == ()
        assert (await keys.news()).serial == 3

    async def test_another_process_knows_a_new_key_when_it_meets_a_token_of_it(
        self, keys: SigningKeys, again: Again
    ) -> None:
        other = await again()
        await other.current()
        new = await rotate(keys)
        token = jwt.encode({}, await keys.current(), "EdDSA", headers={"kid": new})
        kid = jwt.get_unverified_header(token)["kid"]
        assert kid in await other.public(kid)

    async def test_another_process_signs_with_the_new_key_after_a_while(
        self, keys: SigningKeys, again: Again, time: Time
    ) -> None:
        other = await again()
        await other.current()
        await rotate(keys)
        time.ms += LEARN_MS
        self.wait_for_followers(time)
        assert await named(other) == await named(keys)

    async def test_private_halves_that_nothing_is_signed_with_are_not_kept(self, keys: SigningKeys, time: Time) -> None:
        await rotate(keys)
        time.ms += LEARN_MS
        await rotate(keys)
        time.ms += OVERLAP_MS
        await rotate(keys)
        ring = await keys._ring()  # type: ignore[attr-defined]
        assert [bool(key.private) for key in ring.keys] == [False, False, True, True]

    def wait_for_followers(self, time: Time) -> None:
        """Until another process looks again."""
