"""The agent's folder: what is written is read again, and what people write wrong is named."""

import datetime as dt
import stat
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from device_agent.config.agent_config import AgentConfig, Buffer, DeviceEntry, HttpPolling, RoomStream
from device_agent.config.errors import ConfigError
from device_agent.config.identity_store import IdentityStore, Pairing
from device_agent.config.interlock_rule import InterlockRule
from device_agent.protocol.security import signing
from infra.tls import server_ca

ARM = DeviceEntry(name="arm", type="ur5")
MINIMAL = 'server = "http://s"\nname = "n"\n[[devices]]\nname = "arm"\ntype = "ur5"\n'
INTERLOCK = '[[devices.interlocks]]\ndevice = "a-pir"\nstream = "presence"\nfield = "present"\nequals = true\n'
LABELS = st.text(max_size=20).filter(lambda text: not any(0xD800 <= ord(each) < 0xE000 for each in text))
VALUES: Any = st.recursive(
    st.booleans() | st.integers(-(2**31), 2**31) | st.floats(allow_nan=False, allow_infinity=False) | LABELS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(LABELS, inner, max_size=3),
    max_leaves=6,
)


@settings(deadline=None)
@given(name=LABELS, transport=st.sampled_from(["mqtt", "http"]), options=st.dictionaries(LABELS, VALUES, max_size=3))
def test_what_is_written_is_read_again(
    name: str, transport: str, options: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    store = IdentityStore(tmp_path_factory.getbasetemp() / "written")
    rules = (
        InterlockRule(device="abc-pir", stream="presence", field="present", equals=True),
        InterlockRule(device="other", stream="joints", field="velocity_rad_s.0", above=0.5, action="slow", stale_s=1),
    )
    devices = (
        DeviceEntry(name="arm", type="ur5", options=options, interlocks=rules),
        DeviceEntry(name="other", type="ur5", interlocks=rules[:1]),
    )
    room = (RoomStream(device="abc-lamp", stream="light"),)
    polling = HttpPolling(poll="plain", poll_ms=250)
    written = AgentConfig(
        server="http://s",
        name=name,
        transport=transport,
        http=polling,
        devices=devices,
        room=room,
        ca="server-ca.pem" if options else "",
    )
    written = replace(written, buffer=Buffer(max_mb=2), allow_unconfined_scripts=bool(options))
    written.save(store.folder)
    assert AgentConfig.load(store.folder) == written


def test_a_folder_written_before_there_was_a_choice_speaks_mqtt(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text(MINIMAL)
    found = AgentConfig.load(tmp_path)
    assert (found.transport, found.http.poll) == ("mqtt", "long")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('[http]\npoll = "short"\n', "poll"),
        ("[http]\npoll_ms = 1\n", "poll_ms"),
        ("[http]\npoll_s = 1\n", "poll_s"),
        ("[https]\n", "https"),
        ("= 1\n", "agent.toml"),
        ('[[room]]\ndevice = "a-b"\n', "stream"),
        ("[buffer]\nmax_mb = 0.5\n", "max_mb"),
        ("[buffer]\nmax_age_h = nan\n", "max_age_h"),
        ("[buffer]\nmeasurements_hz = 0\n", "measurements_hz"),
        ("[buffer]\nsettle_s = -1\n", "settle_s"),
        ('[[room]]\ndevice = "pir"\nstream = "presence"\n', "'pir' is not a device of this agent .arm.; name one"),
        (f"{INTERLOCK}[[devices.interlocks]]\nspeed = 0.5\n", "device"),
        (INTERLOCK.replace("equals = true", ""), "exactly one of above, below, equals"),
        (INTERLOCK.replace("true", "nan"), "finite"),
        (INTERLOCK + INTERLOCK, "two interlocks of 'arm'"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, named: str) -> None:
    (tmp_path / "agent.toml").write_text(MINIMAL + text)
    with pytest.raises(ConfigError, match=named):
        AgentConfig.load(tmp_path)


def test_nobody_else_may_read_it(tmp_path: Path) -> None:
    store = IdentityStore(tmp_path / "new")
    store.private_key(create=True)
    AgentConfig(server="http://s", name="n", devices=(ARM,)).save(store.folder)
    assert stat.S_IMODE(store.folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in store.folder.iterdir()} == {0o600}


def test_everything_of_the_room_that_is_named_is_a_source_once(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text(
        MINIMAL
        + INTERLOCK
        + '[[room]]\ndevice = "a-pir"\nstream = "presence"\n[[room]]\ndevice = "arm"\nstream = "x"\n'
    )
    assert AgentConfig.load(tmp_path).room_sources == (("a-pir", "presence"), ("arm", "x"))


def test_enrolling_again_keeps_the_room_and_each_devices_interlocks() -> None:
    rules = (InterlockRule(device="a-pir", stream="presence", field="present", equals=True),)
    before = AgentConfig(
        server="http://s",
        name="n",
        devices=(DeviceEntry(name="arm", type="ur5", interlocks=rules),),
        room=(RoomStream(device="a-lamp", stream="light"),),
    )
    said = AgentConfig(server="http://t", name="n", devices=(ARM, DeviceEntry(name="leg", type="ur5")))
    kept = said.with_manual_settings(before)
    assert kept.server == "http://t"
    assert [device.interlocks for device in kept.devices] == [rules, ()]
    assert kept.room == before.room


def test_what_was_written_of_identity_and_pairing_is_read_again(tmp_path: Path) -> None:
    store = IdentityStore(tmp_path)
    key = store.private_key(create=True)
    assert store.private_key(create=True).private_bytes_raw() == store.private_key().private_bytes_raw()
    assert store.pairing() is None
    keys = {signing.key_id(key.public_key()): signing.public_text(key.public_key())}
    pairing = Pairing(agent="a", space="s", account="ann", keys=keys)
    store.save_pairing(pairing)
    assert store.pairing() == pairing
    assert list(pairing.public_keys()) == list(keys)
    store.save_pairing(None)
    assert store.pairing() is None


def test_what_is_missing_or_damaged_says_what_to_do(tmp_path: Path) -> None:
    store = IdentityStore(tmp_path)
    with pytest.raises(ConfigError, match="enroll` first"):
        store.private_key()
    with pytest.raises(ConfigError, match="enroll` first"):
        AgentConfig.load(store.folder)
    (tmp_path / "identity.pem").write_bytes(b"nonsense")
    with pytest.raises(ConfigError, match="cannot be read as a private key"):
        store.private_key()
    pem = ec.generate_private_key(ec.SECP256R1()).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (tmp_path / "identity.pem").write_bytes(pem)
    with pytest.raises(ConfigError, match="not an Ed25519 key"):
        store.private_key()
    (tmp_path / "pairing.json").write_bytes(b"{")
    with pytest.raises(ConfigError, match="delete it and enroll again"):
        store.pairing()
    (tmp_path / "agent.toml").write_text('server = "s"\nname = "n"\ndevices = []\n')
    with pytest.raises(ConfigError, match="at least one device"):
        AgentConfig.load(store.folder)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ConfigError, match="cannot be written"):
        IdentityStore(tmp_path / "file").save_pairing(Pairing(agent="a", space="s", account="ann", keys={}))


def test_a_pinned_authority_is_kept_and_found(tmp_path: Path) -> None:
    store, given = IdentityStore(tmp_path / "agent"), tmp_path / "given.pem"
    server_ca.make(tmp_path / "tls", server_ca.names(("site.example",), ()), now=dt.datetime.now(dt.UTC))
    given.write_bytes((tmp_path / "tls" / server_ca.CA_CERTIFICATE).read_bytes())
    plain = AgentConfig(server="https://s", name="n", devices=(ARM,))
    assert store.certificate_authority(plain.ca) is None
    pinned = replace(plain, ca=store.pin_certificate_authority(given))
    kept = store.certificate_authority(pinned.ca)
    assert kept is not None
    assert kept.read_bytes() == given.read_bytes()
    kept.unlink()
    with pytest.raises(ConfigError, match="enroll --ca"):
        store.certificate_authority(pinned.ca)


@pytest.mark.parametrize("content", [b"no certificate", b"\xff\xfe", None])
def test_what_is_no_authoritys_certificate_is_not_pinned(tmp_path: Path, content: bytes | None) -> None:
    store, given = IdentityStore(tmp_path / "agent"), tmp_path / "given.pem"
    if content is not None:
        given.write_bytes(content)
    with pytest.raises(ConfigError, match=r"--ca: .*given\.pem cannot be read as a certificate"):
        store.pin_certificate_authority(given)


def test_a_lock_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "running.lock").mkdir()
    with pytest.raises(ConfigError, match=r"running\.lock cannot be written"), IdentityStore(tmp_path).lock():
        pass


def test_an_identity_that_was_open_to_others_is_closed_and_it_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = IdentityStore(tmp_path / "agent")
    store.private_key(create=True)
    path = tmp_path / "agent" / "identity.pem"
    path.chmod(0o644)
    store.private_key()
    assert path.stat().st_mode & 0o777 == 0o600
    assert "enroll again" in caplog.text
    caplog.clear()
    store.private_key()
    assert caplog.text == ""
