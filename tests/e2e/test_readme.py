"""The README's own words, run as they stand; only addresses and the folder are those of the test's machine."""

import os
import re
import signal
import subprocess
import time
from pathlib import Path

from tests.harness.browser.product import Machine
from tests.harness.network.brokers import wait_until
from tests.harness.paths import ROOT


def block(name: str, machine: Machine, home: Path) -> str:
    found = re.search(rf"<!-- runs: {name} -->\n```sh\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert found, f"the README has no block '{name}'"
    text = found[1].replace("127.0.0.1:8080", f"127.0.0.1:{machine.port}").replace("8081", str(machine.port + 1))
    return text.replace(".telescope/", f"{home}/").replace("credentials.json", str(home / "credentials.json"))


def test_curl_pairs_a_second_robot_and_runs_a_movement_on_it(machine: Machine, tmp_path: Path) -> None:
    said = tmp_path / "agent.log"
    with said.open("w") as log:
        agent = subprocess.Popen(
            ["bash", "-e", "-c", block("agent", machine, tmp_path)],
            cwd=ROOT,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        wait_until(lambda: "claim code" in said.read_text(), "the claim code")
        code = re.search(r"claim code (\S+)", said.read_text())
        assert code
        script = "\n".join(block(name, machine, tmp_path) for name in ("curl", "mqtt"))
        # A person reads the code and types; the agent has long been up by then.
        script = script.replace('post "devices/', f'{_AWAIT}\npost "devices/', 1)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", script],
            cwd=ROOT,
            env=os.environ | {"LINK": machine.sign_in_link().partition("#sign-in=")[2], "CODE": code[1]},
            capture_output=True,
            text=True,
            timeout=110,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr + said.read_text()
        assert '"status":"done"' in done.stdout.replace(" ", "")
        assert done.stdout.count('"position_rad"') >= 5
    finally:
        os.killpg(agent.pid, signal.SIGTERM)
        agent.wait(20)
    with machine.api() as api:
        second = next(each for each in api.get("/devices")["items"] if each["name"] == "second")
        deadline_s = time.monotonic() + 20
        while second["online"] and time.monotonic() < deadline_s:
            second = api.get(f"/devices/{second['id']}")
            time.sleep(0.1)
        assert not second["online"]
        api.http.delete(f"/agents/{second['agent']}").raise_for_status()


_AWAIT = """for _ in $(seq 200); do
    curl -sS -H "Authorization: Bearer $TOKEN" "$API/devices/$AGENT-second" | grep -q '"online": *true' && break
    sleep 0.1
done"""
