from collections.abc import Iterator

import pytest

from tests.security.tenants.world import World, make


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """Both tenants. Requests do not wait for robots, because none run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("function_app.services.actions.stop.CONFIRM_MS", 1)
        world = make(tmp_path_factory.mktemp("home"))
        with world.cloud:
            yield world
