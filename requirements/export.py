"""Exports the dependency groups of ``pyproject.toml``, fully resolved, for pip. ``--check``: fail if a file differs."""

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXPORTS = {
    "requirements.txt": ("functions", "azure"),
    "requirements/aws.txt": ("functions", "aws"),
    "requirements/agent.txt": ("agent", "sim", "xmpp"),
    "requirements/local.txt": ("local",),
    "requirements/node.txt": ("node",),
    "requirements/bench.txt": ("bench",),
    "requirements/dev.txt": ("dev",),
    "requirements/azure-worker.txt": ("azure-worker",),
}
OPTIONS = {"requirements/azure-worker.txt": ("--no-deps", "--python-version", "3.13")}
"""For what is not resolved like the others: it only runs beside packages that are there already."""
NOWHERE = "sys_platform == 'never'"
"""How ``pyproject.toml`` leaves out what a package asks for and does not need."""
HEADER = "# Exported from pyproject.toml by `make requirements`: groups {}.\n"


def resolved(name: str, groups: tuple[str, ...]) -> str:
    """The file's text. What is pinned in the present file stays where ``pyproject.toml`` allows it."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "requirements.txt"
        if (ROOT / name).exists():
            output.write_text((ROOT / name).read_text(encoding="utf-8"), encoding="utf-8")
        chosen = [word for group in groups for word in ("--group", group)]
        subprocess.run(  # noqa: S603 (the project's own tool)
            [
                sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--universal", "--no-header",
                "--no-annotate", *OPTIONS.get(name, ()), *chosen, "--output-file", str(output),
            ],
            cwd=ROOT,
            check=True,
        )  # fmt: skip
        lines = [
            line
            for line in output.read_text(encoding="utf-8").splitlines()
            if line and line[0] != "#" and NOWHERE not in line
        ]
    return HEADER.format(", ".join(groups)) + "\n".join(lines) + "\n"


def main() -> int:
    """Write the files, or with ``--check`` compare them."""
    stale = []
    for name, groups in EXPORTS.items():
        text = resolved(name, groups)
        if "--check" not in sys.argv:
            (ROOT / name).write_text(text, encoding="utf-8")
        elif not (ROOT / name).exists() or (ROOT / name).read_text(encoding="utf-8") != text:
            stale.append(name)
    if stale:
        sys.stderr.write(f"{', '.join(stale)}: not what pyproject.toml says; run `make requirements`\n")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
