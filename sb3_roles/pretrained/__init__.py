"""Trained weights of the learned rows of the tables, each with its card.

``names()`` are the rows that there are weights for, ``load("hmappo")`` is a controller of episodes:

    from sb3_roles import pretrained
    from sb3_roles.evaluation.episodes import held_out_seed, run_episodes

    records = run_episodes(pretrained.load("hmappo"), "hard", 100, held_out_seed(0))

They lie beside this file, ``<row>/seed_<k>/``; ``sb3-roles publish`` writes them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    from sb3_roles.evaluation.policies import PolicyController
    from sb3_roles.zoo.published import Published

__all__ = ["card", "load", "load_model", "names", "seeds"]


def names() -> tuple[str, ...]:
    """Return the rows that there are weights for."""
    from sb3_roles.zoo.published import published

    return tuple(published())


def seeds(name: str) -> tuple[int, ...]:
    """Return the training seeds of a row, in order.

    :param name: of the row
    :raises ValueError: if there are no weights of it
    """
    from sb3_roles.zoo.published import find_published, published

    return tuple(one.seed for one in published()[find_published(name).row])


def card(name: str, seed: int | None = None) -> dict[str, Any]:
    """Return what the card of some weights says: how they were trained, and what they score.

    :param name: of the row
    :param seed: of the training; by default the first one
    :raises ValueError: if there are no such weights
    """
    return _find(name, seed).card


def load(
    name: str,
    seed: int | None = None,
    *,
    deterministic: bool | None = None,
    communicate: bool = True,
    device: str = "cpu",
) -> PolicyController:
    """Load a policy as a controller of episodes, for ``run_episodes``.

    :param name: of the row
    :param seed: of the training; by default the first one
    :param deterministic: take the likeliest actions instead of drawing them; by default as the
        tables do for this row
    :param communicate: False switches the messages between robots off
    :param device: where the policy computes
    :return: its ``policy`` is the network
    :raises ValueError: if there are no such weights, a file of them is damaged, or there are no
        messages to switch off
    """
    found = _find(name, seed)
    likeliest = not found.card["drawn"] if deterministic is None else deterministic
    return found.load(device).controller(likeliest, communicate)


def load_model(name: str, seed: int | None = None, device: str = "cpu") -> OnPolicyAlgorithm:
    """Load the whole model, with an environment of one team; its critics are untrained.

    :param name: of the row
    :param seed: of the training; by default the first one
    :param device: where it shall be
    :raises ValueError: if there are no such weights, or a file of them is damaged
    """
    model: OnPolicyAlgorithm = _find(name, seed).load(device).model
    return model


def _find(name: str, seed: int | None) -> Published:
    from sb3_roles.zoo.published import find_published

    return find_published(name if seed is None else f"{name}/seed_{seed}")
