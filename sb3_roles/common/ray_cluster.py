"""A connection to a Ray cluster; only this module imports Ray (extra ``ray``)."""

from __future__ import annotations

import logging
import os
import socket
from typing import Any

# Read when Ray is imported: it tells nobody that it is used.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import ray

from sb3_roles.common.names import one_line

__all__ = ["LOCAL", "RayError", "cluster_cpus", "connect", "disconnect", "ray"]

LOCAL = "local"
# What is sent is small; Ray would take a third of the memory.
_OBJECT_STORE_BYTES = 100_000_000
_SECONDS_TO_CONNECT = 10.0


class RayError(RuntimeError):
    """No cluster could be reached or started, or it is lost; one line."""


def connect(address: str, n_cpus: int = 1, object_store_bytes: int = _OBJECT_STORE_BYTES) -> None:
    """Connect this process to a cluster.

    :param address: of a running cluster, ``HOST:PORT`` or ``"auto"``, or ``"local"`` to start one
    :param n_cpus: CPUs of a local cluster
    :param object_store_bytes: memory of a local cluster for what is sent
    :raises RayError: if there is no such cluster
    """
    _check_address(address)
    own: dict[str, Any] = {}
    if address == LOCAL:
        own = {"num_cpus": n_cpus, "include_dashboard": False}
        own["object_store_memory"] = object_store_bytes
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **own)
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        raise RayError(f"{address}: no Ray cluster: {one_line(error)[:200]}") from None


def disconnect() -> None:
    """Leave the cluster, which ends what it still does, and stop it if it was started here."""
    ray.shutdown()


def cluster_cpus() -> int:
    """Return the CPUs of the cluster, which may come and go; at least 1."""
    return max(1, int(ray.cluster_resources().get("CPU", 1)))


def _check_address(address: str) -> None:
    """Find out whether anybody listens: Ray would try for minutes."""
    if address in (LOCAL, "auto"):
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        raise RayError(f"must be {LOCAL}, auto or HOST:PORT, got {address!r}")
    try:
        socket.create_connection((host, int(port)), _SECONDS_TO_CONNECT).close()
    except (OSError, OverflowError) as error:
        raise RayError(f"{address}: no Ray cluster: {one_line(error)}") from None
