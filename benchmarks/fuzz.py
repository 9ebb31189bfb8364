"""Every reader with 500 damaged files or odd values of each kind, in place of the 25 of the tests.

    python benchmarks/fuzz.py [EXAMPLES]

Ends with the exit status of pytest: 0 where each was read, or refused with one line.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = ("tests/test_fuzz.py", "tests/test_fuzz_records.py", "tests/detect/test_coco.py")

if __name__ == "__main__":
    examples = sys.argv[1] if len(sys.argv) > 1 else "500"
    words = [sys.executable, "-m", "pytest", "-q", "-n", "0", *FILES]
    environment = {**os.environ, "FUZZ_EXAMPLES": examples, "PYTHONPATH": str(ROOT)}
    raise SystemExit(subprocess.run(words, cwd=ROOT, env=environment, check=False).returncode)
