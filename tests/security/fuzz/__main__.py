"""``python -m tests.security.fuzz [SECONDS] [TARGET …]``: fuzz each target this long, print a coverage table."""

import sys

from tests.security.fuzz import instrumented
from tests.security.fuzz.session import HEAD, fuzz

if __name__ == "__main__":
    seconds, *names = sys.argv[1:] or ["60"]
    print(HEAD)
    for name in names or instrumented.MODULES:
        for session in fuzz([name], f"-max_total_time={seconds}"):
            print(session.row, flush=True)
