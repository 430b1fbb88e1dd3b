"""Train an algorithm: ``python train.py --help``."""

import sys

from sb3_roles.zoo.train import main

sys.exit(main())
