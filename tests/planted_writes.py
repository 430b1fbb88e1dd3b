"""The trials of saves and of full disks, with a fault: files are written in place."""

from __future__ import annotations

import io
import json
import sys
import time

from sb3_roles.common import checkpoint, files
from sb3_roles.prove import disk_trials, save_loops


def in_place(path, write, check=None):
    buffer = io.BytesIO()
    write(buffer)
    whole = buffer.getvalue()
    half = len(whole) // 2
    with open(path, "wb") as file:
        file.write(whole[:half])
        file.flush()
        # On a busy machine, too, most kills come here.
        time.sleep(0.02)
        file.write(whole[half:])


if __name__ == "__main__":
    files.replace_file = checkpoint.replace_file = in_place
    if sys.argv[1].startswith("{"):
        disk_trials.main(json.loads(sys.argv[1]))
    else:
        save_loops.main(sys.argv[1:])
