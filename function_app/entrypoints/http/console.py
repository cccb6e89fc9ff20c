"""The built console, as static files."""

from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

_ICON = "favicon.ico"
"""Where browsers look for a picture of what is no page of the console's: an answer of the API, say."""
_FOR_EVER = "public, max-age=31536000, immutable"


class Console(StaticFiles):
    """Files of the console's folder. Assets carry a hash in their name and are kept for ever, the page is asked for."""

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, html=True, check_dir=False)
        self._folder = folder
        self.config_checked = True  # a folder that is not there is an answer of ours, not a fault

    async def get_response(self, path: str, scope: Scope) -> Response:
        """The file; 404 with a hint when the console was never built."""
        if path.startswith("api"):
            raise HTTPException(404, "There is no such resource; see /api/docs")
        if not (self._folder / "index.html").is_file():
            raise HTTPException(404, "The console is not built; run `make console`")
        response = await super().get_response(self._icon() if path == _ICON else path, scope)
        response.headers["Cache-Control"] = _FOR_EVER if path.startswith("assets") else "no-cache"
        return response

    def _icon(self) -> str:
        """The file with the console's own picture, which has a hash in its name."""
        found = next(self._folder.glob("assets/icon-*.svg"), None)
        return _ICON if found is None else f"assets/{found.name}"
