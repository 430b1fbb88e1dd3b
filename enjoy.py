"""Watch a trained policy: ``python enjoy.py --help``."""

from sb3_roles.zoo.cli import main

# Processes that are spawned import this file again.
if __name__ == "__main__":
    raise SystemExit(main(script="enjoy"))
