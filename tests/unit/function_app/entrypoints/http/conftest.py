from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.harness.cloud.cloud import Cloud, settings


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cloud]:
    """Functions with real tables and without a broker."""
    folder = tmp_path_factory.mktemp("home")
    console = folder / "console"
    (console / "assets").mkdir(parents=True)
    (console / "index.html").write_text("<!doctype html><title>console</title>")
    (console / "assets" / "icon-0123abcd.svg").write_text("<svg/>")
    (console / "assets" / "app-0123abcd.js").write_text("export {};")
    with Cloud(settings(Path(folder), console=console)) as cloud:
        yield cloud
