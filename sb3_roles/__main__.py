"""``python -m sb3_roles``: the same as the console script ``sb3-roles``."""

import sys

from sb3_roles.zoo.cli import main

if __name__ == "__main__":
    sys.exit(main())
