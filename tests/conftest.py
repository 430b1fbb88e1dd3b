"""What all tests share: one thread each, so that they run side by side and repeat exactly."""

import os

for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import torch  # noqa: E402

torch.set_num_threads(1)
