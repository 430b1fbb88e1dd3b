"""The trials of saves and of full disks, with a fault: files are written in place."""

from __future__ import annotations

import json
import sys

from sb3_roles.common import checkpoint, files
from sb3_roles.prove import disk_trials, save_loops


def in_place(path, write, check=None):
    with open(path, "wb") as file:
        write(file)


if __name__ == "__main__":
    files.replace_file = checkpoint.replace_file = in_place
    if sys.argv[1].startswith("{"):
        disk_trials.main(json.loads(sys.argv[1]))
    else:
        save_loops.main(sys.argv[1:])
