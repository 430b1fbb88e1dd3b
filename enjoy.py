"""Watch a trained policy, see ``python enjoy.py --help``."""

from sb3_roles.zoo.enjoy import main

if __name__ == "__main__":
    raise SystemExit(main())
