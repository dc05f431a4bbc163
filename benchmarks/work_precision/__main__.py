"""``python -m benchmarks.work_precision``: one thread before anything else is imported."""

import sys

from benchmarks.work_precision import threads

if __name__ == "__main__":
    threads.enforce(sys.argv[1:])
    from benchmarks.work_precision.command import main

    sys.exit(main(sys.argv[1:]))
