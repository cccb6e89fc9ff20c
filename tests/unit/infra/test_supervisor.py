import os
from pathlib import Path

import pytest

from infra.local import supervisor
from infra.local.supervisor import SupervisedProcess


def test_a_long_log_is_moved_and_its_process_continues_in_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervisor, "_MAX_LOG_BYTES", 5)
    waits = "import sys, time\nprint('first', flush=True)\nwhile open(sys.argv[1]).read() == '': time.sleep(0.01)\n"
    signal_file = tmp_path / "signal"
    signal_file.touch()
    child = SupervisedProcess("p", ["-c", waits + "print('later')", str(signal_file)], dict(os.environ), tmp_path)
    child.start()
    try:
        child.wait_for_line("first", 20)
        child.limit_log()
        assert child.output_lines() == []
        signal_file.write_text("go")
        child.wait_for_line("later", 20)
        assert (tmp_path / "p.log").read_bytes() == b"later\n"
        assert (tmp_path / "p.log.1").read_bytes() == b"first\n"
    finally:
        child.stop()
