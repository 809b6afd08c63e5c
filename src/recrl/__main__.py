"""``python -m recrl``: the command ``recrl-sweep``."""

import sys

from recrl.orchestrator.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
