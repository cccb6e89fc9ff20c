"""``agent.toml`` is written and read without loss; mistakes are named."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from device_agent.config.agent_config import AgentConfig, Buffer, DeviceEntry, HttpPolling, Recording, RoomStream
from device_agent.config.errors import ConfigError
from device_agent.config.interlock_rule import InterlockRule
from device_agent.protocol import CameraStream, Stream
from device_agent.protocol.manifests.robot_type import Diagnostic
from device_agent.protocol.manifests.room import Control, Watch

ARM = DeviceEntry(name="arm", type="ur5")
BOILER = DeviceEntry(
    name="boiler",
    type="boiler",
    driver="modbus",
    streams=(Stream(name="water", rate_hz=0.5),),
    cameras=(CameraStream(name="view", rate_hz=1.0),),
    captures=("image",),
    controls=(Control(name="target", label="Target", unit="°C", lower=10.0, upper=80.0),),
    diagnostics=(Diagnostic(stream="water", fields="temperature_c", label="Water", high=90.0),),
    watch=(Watch(source="water", silent_s=60.0),),
    position_m=(1.0, 2.0, 0.5),
    options={"host": "boiler", "streams": {"water": {"temperature_c": {"address": 0}}}},
)
DESCRIBED = '[[devices]]\nname = "x"\ntype = "thermometer"\n'
STREAMS = 'streams = [{ name = "air", rate_hz = 1.0 }]\n'
MINIMAL = 'server = "http://s"\nname = "n"\n[[devices]]\nname = "arm"\ntype = "ur5"\n'
INTERLOCK = '[[devices.interlocks]]\ndevice = "a-pir"\nstream = "presence"\nfield = "present"\nequals = true\n'
RULES = (
    InterlockRule(device="abc-pir", stream="presence", field="present", equals=True),
    InterlockRule(device="other", stream="joints", field="velocity_rad_s.0", above=0.5, action="slow", stale_s=1),
)
LABELS = st.text(st.characters(exclude_categories=("Cc", "Cf", "Cs", "Zl", "Zp")), max_size=20)
VALUES: Any = st.recursive(
    st.booleans() | st.integers(-(2**31), 2**31) | st.floats(allow_nan=False, allow_infinity=False) | LABELS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(LABELS, inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=30)
@given(name=LABELS, transport=st.sampled_from(["mqtt", "http"]), options=st.dictionaries(LABELS, VALUES, max_size=3))
def test_saved_configuration_is_loaded(
    name: str, transport: str, options: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.getbasetemp() / "written"
    config = AgentConfig(
        server="http://s",
        name=name,
        transport=transport,
        http=HttpPolling(poll="plain", poll_ms=250),
        devices=(
            DeviceEntry(name="arm", type="ur5", options=options, interlocks=RULES),
            DeviceEntry(name="other", type="ur5", room="lab", interlocks=RULES[:1]),
            BOILER,
        ),
        room=(RoomStream(device="abc-lamp", stream="light"),),
        ca="server-ca.pem" if options else "",
        buffer=Buffer(max_mb=2),
        recording=Recording(enabled=False, max_gb=0.5),
        allow_unconfined_scripts=bool(options),
    )
    config.save(folder)
    assert AgentConfig.load(folder) == config


def test_defaults(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text(MINIMAL)
    config = AgentConfig.load(tmp_path)
    assert (config.transport, config.http.poll) == ("mqtt", "long")


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
        ("[recording]\nmax_gb = 0\n", "max_gb"),
        ("[recording]\nmax_age_days = 0\n", "max_age_days"),
        ("[recording]\nmin_free_gb = -1\n", "min_free_gb"),
        ('[[room]]\ndevice = "pir"\nstream = "presence"\n', "'pir' is not a device of this agent .arm.; name a"),
        (f"{INTERLOCK}[[devices.interlocks]]\nspeed = 0.5\n", "device"),
        (INTERLOCK.replace("equals = true", ""), "exactly one of above, below, equals"),
        (INTERLOCK.replace("true", "nan"), "finite"),
        (INTERLOCK + INTERLOCK, "two interlocks of 'arm'"),
        ('[[devices]]\nname = "arm"\ntype = "ur5"\n', "at least one device, each with a unique name"),
        (DESCRIBED + STREAMS, "'x' needs `driver`; `python -m device_agent devices` lists the drivers"),
        (f'{DESCRIBED}driver = "modbus"\nroom = "lab"\n{STREAMS}', "the room 'lab' describes 'x'; remove `room`"),
        (f'{DESCRIBED}driver = "modbus"\n{STREAMS.replace("1.0", "99.0")}', "rate_hz of stream 'air' of device 'x'"),
        (f'{DESCRIBED}driver = "modbus"\n{STREAMS}watch = [{{ source = "wind" }}]\n', "there is no 'wind'; known: air"),
        (f'{DESCRIBED}watch = [{{ source = "wind" }}]\n', "'x' has no `streams` or `cameras` for `diagnostics`"),
        (None, "at least one device"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, text: str | None, named: str) -> None:
    content = 'server = "s"\nname = "n"\ndevices = []\n' if text is None else MINIMAL + text
    (tmp_path / "agent.toml").write_text(content)
    with pytest.raises(ConfigError, match=named):
        AgentConfig.load(tmp_path)


def test_room_sources_are_unique(tmp_path: Path) -> None:
    room = '[[room]]\ndevice = "a-pir"\nstream = "presence"\n[[room]]\ndevice = "arm"\nstream = "x"\n'
    (tmp_path / "agent.toml").write_text(MINIMAL + INTERLOCK + room)
    assert AgentConfig.load(tmp_path).room_sources == (("a-pir", "presence"), ("arm", "x"))


def test_enrolling_again_keeps_manual_settings() -> None:
    previous = AgentConfig(
        server="http://s",
        name="n",
        devices=(DeviceEntry(name="arm", type="ur5", interlocks=RULES[:1]),),
        room=(RoomStream(device="a-lamp", stream="light"),),
        buffer=Buffer(max_mb=2),
        recording=Recording(enabled=False, max_gb=0.5),
        allow_unconfined_scripts=True,
    )
    new = AgentConfig(server="http://t", name="n", devices=(ARM, DeviceEntry(name="leg", type="ur5")))
    merged = new.with_manual_settings(previous)
    assert merged.server == "http://t"
    assert [device.interlocks for device in merged.devices] == [RULES[:1], ()]
    assert (merged.room, merged.buffer, merged.allow_unconfined_scripts) == (previous.room, previous.buffer, True)
    assert merged.recording == previous.recording
