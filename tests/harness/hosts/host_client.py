"""HTTP access of people and robots to the functions under a host."""

import asyncio
from collections.abc import Mapping
from typing import Any, cast

import httpx

from device_agent.protocol.security import signing
from function_app import bootstrap, settings
from tests.fakes.agent import Robot
from tests.fakes.clock import MovingClock
from tests.harness.cloud.cloud import API, Cloud, connect_to_broker
from tests.harness.hosts.host import PATIENCE_S, Host


class HostClient:
    """Replaces ``Cloud`` for the fake robot: sends its requests to a host."""

    def __init__(self, host: Host, environment: Mapping[str, str]) -> None:
        self.host = host
        self.clock = MovingClock()
        self._environment = environment
        self.connect = connect_to_broker

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        return httpx.request(method, self.host.url + path, timeout=PATIENCE_S, **options)

    def link(self, name: str) -> str:
        """A one-time sign-in token, created by functions in this process."""

        async def create() -> str:
            functions = bootstrap.build(settings.read(self._environment))
            link = await functions.sign_in.link(await functions.sign_in.account(name))
            await functions.close()
            return link

        return asyncio.run(create())

    def sign_in(self, name: str) -> httpx.Client:
        answer = self.request("POST", f"{API}/auth/sign-in", json={"link": self.link(name)})
        assert answer.status_code == 200, answer.text
        token = {"Authorization": f"Bearer {answer.json()['access_token']}"}
        return httpx.Client(base_url=self.host.url + API, headers=token, timeout=PATIENCE_S)

    def robot(self) -> Robot:
        """A fake robot; it uses only the methods of ``Cloud`` that this class has."""
        return Robot(cast("Cloud", self), ("arm",))

    def pair(self, owner: httpx.Client, robot: Robot) -> None:
        claimed = owner.post("/agents/claim", json={"code": robot.code()})
        assert claimed.status_code == 200, claimed.text
        state = robot.enrollment()
        robot.space = state["space"]
        robot._keys = {key["id"]: signing.public_key(key["public"]) for key in state["keys"]}
