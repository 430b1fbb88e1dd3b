"""Where demonstrations come from: a file, or a recording that is made for the run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from area_search.kernels import METRICS
from area_search.scenes import Scene
from sb3_roles.baselines import controller_class
from sb3_roles.gnn.demonstrations import Demonstrations, load_demonstrations
from sb3_roles.gnn.recording import record


def validation_episodes(n_episodes: int, share: float) -> int:
    """Return how many episodes are kept for validation.

    :param n_episodes: all of them
    :param share: in [0, 1]
    :raises ValueError: if none are left for one of the two
    """
    count = round(share * n_episodes)
    if not 0 < count < n_episodes:
        raise ValueError(
            f"validation_share {share} of {n_episodes} episodes leaves none to validate on, or "
            "none to learn from"
        )
    return count


def check_recording(controller: str, scene: Scene | None) -> Scene:
    """Refuse what can not be recorded, before it is begun.

    :param controller: name of a scripted controller
    :param scene: of the environment
    :return: the scene
    :raises ValueError: if there is no scene, or no such controller
    :raises ImportError: if the controller needs what is not installed; one line
    """
    if scene is None:
        raise ValueError("the environment is not area search: give demonstrations, a file of them")
    controller_class(controller)()
    return scene


def obtain(
    file: str | None,
    controller: str,
    scene: Scene | None,
    n_episodes: int,
    seed: int,
    path: Path | None,
    report: Callable[[int], None] | None,
) -> Demonstrations:
    """Read demonstrations, or record them.

    :param file: what to read; None to record
    :param controller: whom to record
    :param scene: of the environment
    :param n_episodes: how many are wanted: the first ones of the file
    :param seed: of the recording
    :param path: file of the recording, which goes on with what is there
    :param report: told how many episodes are recorded, from time to time
    :raises DemonstrationError: if a file is damaged, of another recording, or has too few episodes
    :raises ValueError: see :func:`check_recording`
    :raises ImportError: the same
    """
    if file is not None:
        return load_demonstrations(file).first(n_episodes)
    scene = check_recording(controller, scene)
    return record(controller, scene, n_episodes, seed, path, report=report)


def describe(found: Demonstrations, file: str | None) -> dict[str, Any]:
    """Return what there is to learn from, plain data.

    :param found: what is learned from
    :param file: where it was read; None for a recording of the run itself
    :return: ``file``, ``sha256`` of the content (:meth:`Demonstrations.digest`), ``controller``,
        ``seed``, ``episodes``, ``steps`` of each, ``robots``, the mean ``METRICS`` as fractions,
        and the ``scene``
    """
    means = zip(METRICS, found.metrics.mean(axis=0).tolist(), strict=True)
    return {
        "file": file,
        "sha256": found.digest(),
        "controller": found.facts["controller"],
        "seed": found.facts.get("seed"),
        "episodes": len(found),
        "steps": found.n_steps,
        "robots": found.n_agents,
        **dict(means),
        "scene": dict(found.facts["scene"]),
    }


def summary(facts: dict[str, Any], scene: Scene | None) -> str:
    """Say in one line what there is to learn from, and how its scene differs from the run's.

    :param facts: of :func:`describe`
    :param scene: of the environment
    """
    shown = facts["scene"]
    text = (
        f"demonstrations ({facts['file'] or 'recorded'}): {facts['episodes']} episodes of "
        f"{facts['controller']}, {facts['steps']} steps of {facts['robots']} robots on "
        f"{shown['height']} x {shown['width']} cells, seed {facts['seed']!r}; "
        + ", ".join(f"{name} {100 * facts[name]:.1f} %" for name in METRICS)
        + f"; sha256 {facts['sha256'][:16]}"
    )
    # A recording has no early stop, whatever the run has.
    own = {} if scene is None else scene.with_options(early_stop_patience=None).facts()
    differences = [
        f"{key} {shown.get(key)!r}, here {value!r}"
        for key, value in own.items()
        if shown.get(key) != value
    ]
    return text + ("; another scene than the run's: " + "; ".join(differences)) * bool(differences)
