"""The agent's folder: what is written is read again, and what people write wrong is named."""

import stat
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from device_agent.runtime.home import Configuration, DeviceEntry, Home, HomeError, HttpPolling

ARM = DeviceEntry(name="arm", type="ur5")
MINIMAL = 'server = "http://s"\nname = "n"\n[[devices]]\nname = "arm"\ntype = "ur5"\n'
LABELS = st.text(max_size=20).filter(lambda text: not any(0xD800 <= ord(each) < 0xE000 for each in text))
VALUES: Any = st.recursive(
    st.booleans() | st.integers(-(2**31), 2**31) | st.floats(allow_nan=False, allow_infinity=False) | LABELS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(LABELS, inner, max_size=3),
    max_leaves=6,
)


@given(name=LABELS, transport=st.sampled_from(["mqtt", "http"]), options=st.dictionaries(LABELS, VALUES, max_size=3))
def test_what_is_written_is_read_again(
    name: str, transport: str, options: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    home = Home(tmp_path_factory.getbasetemp() / "written")
    devices = (DeviceEntry(name="arm", type="ur5", options=options), DeviceEntry(name="other", type="ur5"))
    polling = HttpPolling(poll="plain", poll_ms=250)
    written = Configuration(server="http://s", name=name, transport=transport, http=polling, devices=devices)
    home.save_configuration(written)
    assert home.configuration() == written


def test_a_folder_written_before_there_was_a_choice_speaks_mqtt(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text(MINIMAL)
    found = Home(tmp_path).configuration()
    assert (found.transport, found.http.poll) == ("mqtt", "long")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('[http]\npoll = "short"\n', "poll"),
        ("[http]\npoll_ms = 1\n", "poll_ms"),
        ("[http]\npoll_s = 1\n", "poll_s"),
        ("[https]\n", "https"),
        ("= 1\n", "agent.toml"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, named: str) -> None:
    (tmp_path / "agent.toml").write_text(MINIMAL + text)
    with pytest.raises(HomeError, match=named):
        Home(tmp_path).configuration()


def test_nobody_else_may_read_it(tmp_path: Path) -> None:
    home = Home(tmp_path / "new")
    home.identity(create=True)
    home.save_configuration(Configuration(server="http://s", name="n", devices=(ARM,)))
    assert stat.S_IMODE(home.folder.stat().st_mode) == 0o700
    assert {stat.S_IMODE(path.stat().st_mode) for path in home.folder.iterdir()} == {0o600}
