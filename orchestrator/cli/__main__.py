"""``python -m recrl.orchestrator.cli``: the command ``recrl-sweep``."""

import sys

from recrl.orchestrator.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
