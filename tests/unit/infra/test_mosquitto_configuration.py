import json
import os
from pathlib import Path

import pytest

from infra.mosquitto import admission, configuration
from infra.service_user import ServiceUser


def write(home: Path, tcp_port: int = 1) -> None:
    configuration.write(
        home,
        tcp_port=tcp_port,
        websocket_port=2,
        plugin_path="/x.so",
        max_connections=1000,
        user=ServiceUser(os.geteuid(), os.getegid()),
        require_certificate=False,
    )


def test_everything_is_denied_by_default(tmp_path: Path) -> None:
    defaults = configuration.initial_security("x")["defaultACLAccess"]
    denied = {"publishClientSend": False, "publishClientReceive": False, "subscribe": False}
    assert defaults == {**denied, "unsubscribe": True}
    write(tmp_path)
    lines = (tmp_path / configuration.CONFIGURATION_FILE).read_text().splitlines()
    assert "allow_anonymous false" in lines
    assert [line for line in lines if line.startswith("listener")] == ["listener 1 127.0.0.1", "listener 2 127.0.0.1"]


def test_a_second_start_keeps_rights_and_password_but_updates_ports(tmp_path: Path) -> None:
    write(tmp_path)
    names = (configuration.SECURITY_FILE, configuration.PASSWORD_FILE)
    before = [(tmp_path / name).read_text() for name in names]
    write(tmp_path, tcp_port=3)
    assert [(tmp_path / name).read_text() for name in names] == before
    assert "listener 3 127.0.0.1" in (tmp_path / configuration.CONFIGURATION_FILE).read_text()


def test_an_update_restores_the_functions_rights_and_keeps_grants(tmp_path: Path) -> None:
    write(tmp_path)
    path = tmp_path / configuration.SECURITY_FILE
    expected, outdated = json.loads(path.read_text()), json.loads(path.read_text())
    acl = {"acltype": "publishClientSend", "topic": "t", "priority": 0, "allow": True}
    grant = {"rolename": "arm", "acls": [acl]}
    del outdated["roles"][0]["acls"][2:]
    outdated["roles"].append(grant)
    outdated["defaultACLAccess"]["unsubscribe"] = False
    path.write_text(json.dumps(outdated))
    write(tmp_path)
    updated = json.loads(path.read_text())
    assert updated["roles"] == [*expected["roles"], grant]
    assert updated["defaultACLAccess"] == expected["defaultACLAccess"]


def test_the_password_is_only_in_its_own_file(tmp_path: Path) -> None:
    write(tmp_path)
    password = (tmp_path / configuration.PASSWORD_FILE).read_text().strip()
    assert len(password) >= 40
    assert password not in (tmp_path / configuration.SECURITY_FILE).read_text()
    assert password not in (tmp_path / configuration.CONFIGURATION_FILE).read_text()
    assert json.loads((tmp_path / configuration.SECURITY_FILE).read_text())["clients"][0]["username"] == "service"


def test_a_start_removes_expired_clients_and_keeps_others(tmp_path: Path) -> None:
    write(tmp_path)
    path = tmp_path / configuration.SECURITY_FILE
    security = json.loads(path.read_text())
    names = ["agent:arm/arm/1/a", f"agent:arm/arm/{2**40}/b", "added by an administrator"]
    security["clients"] += [{"username": name, "roles": [{"rolename": name}]} for name in names]
    security["roles"] += [{"rolename": name, "acls": []} for name in names]
    path.write_text(json.dumps(security))
    write(tmp_path)
    updated = json.loads(path.read_text())
    assert [client["username"] for client in updated["clients"]] == ["service", *names[1:]]
    assert [role["rolename"] for role in updated["roles"]] == ["service", *names[1:]]


@pytest.mark.parametrize(("requested", "files"), [(10_000, 1_024), (10_000, 65_536), (10_000, 256), (4, 1_024)])
def test_limits_of_connections_fit_the_open_files(requested: int, files: int) -> None:
    limits = admission.limits(requested, files)
    assert limits.files <= files
    assert 1 <= limits.clients <= requested
    assert limits.reserve >= 1


def test_without_a_limit_of_open_files_all_requested_clients_are_possible() -> None:
    assert admission.limits(100_000, None).clients == 100_000
