"""Exports the dependency groups of ``pyproject.toml``, fully resolved and with hashes, for pip.

With ``--check`` it writes nothing and fails if the pinned versions of a file differ. Hashes are not compared: an index
may add a wheel to a version that is already pinned.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
EXPORTS = {
    "requirements.txt": ("functions", "azure"),
    "requirements/aws.txt": ("functions", "aws"),
    "requirements/agent.txt": ("agent", "sim", "xmpp", "ros"),
    "requirements/agent-build.txt": ("agent-build",),
    "requirements/lerobot.txt": ("lerobot",),
    "requirements/lerobot-new.txt": ("lerobot-new",),
    "tests/contract/exports/requirements.txt": ("lerobot-dataset",),
    "tests/contract/exports/rerun.txt": ("rerun",),
    "requirements/local.txt": ("local",),
    "requirements/naoqi.txt": ("naoqi",),
    "requirements/node.txt": ("node",),
    "requirements/uv.txt": ("uv",),
    "requirements/bench.txt": ("bench",),
    "requirements/docs.txt": ("docs",),
    "requirements/dev.txt": ("dev",),
    "requirements/azure-worker.txt": ("azure-worker",),
    "requirements/mutation.txt": ("mutation",),
}
OPTIONS = {
    "requirements/azure-worker.txt": ("--no-deps", "--python-version", "3.13"),
    "requirements/lerobot-new.txt": ("--python-version", "3.12"),
    "tests/contract/exports/requirements.txt": ("--python-version", "3.12"),
    "tests/contract/exports/rerun.txt": ("--no-deps",),
    "requirements/mutation.txt": ("--constraint", "requirements/dev.txt"),
}
"""Extra options of ``uv pip compile``. The Functions worker and Rerun run beside packages that are installed already.
Packages for mutation testing are installed beside those of ``dev``."""
EXCLUDED = "sys_platform == 'never'"
"""Marker with which ``pyproject.toml`` leaves out a package that another one requests and does not need."""
HEADER = "# Exported from pyproject.toml by `make requirements`: groups {}.\n"


def resolve(name: str, groups: tuple[str, ...]) -> list[str]:
    """Returns one entry per package: the pin and its hashes, joined by line continuations.

    Versions of the present file are kept where ``pyproject.toml`` allows them.

    Raises:
        subprocess.CalledProcessError: The groups cannot be resolved.
    """
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "requirements.txt"
        if (ROOT / name).exists():
            output.write_text((ROOT / name).read_text(encoding="utf-8"), encoding="utf-8")
        group_options = [word for group in groups for word in ("--group", group)]
        subprocess.run(  # noqa: S603 (the project's own tool)
            [
                sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--universal", "--no-header",
                "--no-annotate", "--generate-hashes", *OPTIONS.get(name, ()), *group_options,
                "--output-file", str(output),
            ],
            cwd=ROOT,
            check=True,
        )  # fmt: skip
        text = output.read_text(encoding="utf-8").replace("\\\n    ", "\\\0")
    entries = [line.replace("\\\0", "\\\n    ") for line in text.splitlines() if line and line[0] != "#"]
    return [entry for entry in entries if EXCLUDED not in entry]


def pins(text: str) -> list[str]:
    """Returns the pinned packages of a requirements file, without hashes."""
    lines = (line.removesuffix("\\").strip() for line in text.splitlines())
    return [line for line in lines if line and not line.startswith(("#", "--hash="))]


def main() -> int:
    """Writes the files, or compares them with ``--check``."""
    stale = []
    for name, groups in EXPORTS.items():
        entries = resolve(name, groups)
        path = ROOT / name
        if "--check" not in sys.argv:
            path.write_text(HEADER.format(", ".join(groups)) + "\n".join(entries) + "\n", encoding="utf-8")
        elif not path.exists() or pins(path.read_text(encoding="utf-8")) != pins("\n".join(entries)):
            stale.append(name)
    if stale:
        sys.stderr.write(f"{', '.join(stale)} differ from pyproject.toml; run `make requirements`\n")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main())
