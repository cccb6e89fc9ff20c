"""The built console, as static files."""

from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

_ICON = "favicon.ico"
"""Browsers request this icon for responses that are not pages of the console, such as those of the API."""
_IMMUTABLE = "public, max-age=31536000, immutable"


class Console(StaticFiles):
    """Files of the console. Assets have a hash in their name and are cached without limit; pages are revalidated."""

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, html=True, check_dir=False)
        self._folder = folder
        self.config_checked = True  # a missing folder causes a 404 response, not an error

    async def get_response(self, path: str, scope: Scope) -> Response:
        """The file; 404 with a hint if the console is not built."""
        if path.startswith("api"):
            raise HTTPException(404, "No such resource; see /api/docs")
        if not (self._folder / "index.html").is_file():
            raise HTTPException(404, "The console is not built; run `make console`")
        response = await super().get_response(self._icon() if path == _ICON else path, scope)
        response.headers["Cache-Control"] = _IMMUTABLE if path.startswith("assets") else "no-cache"
        return response

    def _icon(self) -> str:
        """Path of the console's icon, which has a hash in its name."""
        icon = next(self._folder.glob("assets/icon-*.svg"), None)
        return _ICON if icon is None else f"assets/{icon.name}"
