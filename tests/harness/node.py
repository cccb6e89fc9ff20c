"""Programs for Node.js that tests start."""

import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Timer

START_WITHIN_S = 60


@contextlib.contextmanager
def start_node(
    folder: Path, package: str, arguments: Sequence[str], ready: re.Pattern[str], *, count: int = 1, line: str = ""
) -> Iterator[list[re.Match[str]]]:
    """Run a program that ends with its standard input.

    Args:
        folder: Folder with ``node_modules``.
        package: The package that must be installed there.
        arguments: Arguments of ``node``.
        ready: Expected in ``count`` output lines before the program is ready; yields the matches.
        count: Number of these lines.
        line: Written to standard input.
    """
    installed = folder / "node_modules" / package
    assert installed.exists(), f"{package} is not installed; run `npm ci --prefix {folder}`, as `make test` does"
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    node = shutil.which("node", path=path)
    assert node, "Node.js is not installed; `make test` installs it"
    with subprocess.Popen(
        [node, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        timeout = Timer(START_WITHIN_S, process.kill)
        timeout.start()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(line)
            process.stdin.flush()
            output = ""
            matches: list[re.Match[str]] = []
            while len(matches) < count:
                text = process.stdout.readline()
                assert text, f"{package} did not start: {output}"
                output += text
                matches += ready.finditer(text)
        finally:
            timeout.cancel()
            timeout.join()
        try:
            yield matches
        finally:
            process.communicate(timeout=START_WITHIN_S)  # closes its standard input, which ends it
